"""What scene.yaml says about training, as the reconstruction's own options."""

from dataclasses import fields
from typing import TYPE_CHECKING

from devrf.capture.scene import Scene
from devrf.pipelines.config.scene import SceneConfig

if TYPE_CHECKING:
    from devrf.reconstruct.options import TrainingOptions


def training_options(config: SceneConfig, scene: Scene) -> "TrainingOptions":
    """The preset, for such a scene, with what the file overrides."""
    from devrf.reconstruct.options import Overrides, preset

    named = {f.name: getattr(config.reconstruct, f.name) for f in fields(Overrides)}
    return preset(config.preset, Overrides(**named), forward=scene.ndc is not None)
