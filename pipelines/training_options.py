"""What scene.yaml says about training, as the reconstruction's own options."""

from typing import TYPE_CHECKING

from devrf.capture.scene import Scene
from devrf.pipelines.config.scene import SceneConfig

if TYPE_CHECKING:
    from devrf.reconstruct.options import Options


def training_options(config: SceneConfig, scene: Scene) -> "Options":
    """The preset, for such a scene, with what the file overrides."""
    from devrf.reconstruct.options import preset

    chosen = config.reconstruct.model_dump(exclude={"image_scale"})  # that one is the scene's
    return preset(config.preset, forward=scene.ndc is not None, **chosen)
