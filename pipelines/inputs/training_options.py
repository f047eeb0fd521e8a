"""What scene.yaml says about training, as the reconstruction's own options."""

from typing import TYPE_CHECKING

from devrf.capture.scene import Scene
from devrf.pipelines.config.scene import SceneConfig

if TYPE_CHECKING:
    from devrf.reconstruct.options import Options


def training_options(config: SceneConfig, scene: Scene) -> "Options":
    """The preset, for such a scene, with what the file overrides."""
    from devrf.reconstruct.options import preset

    chosen = config.reconstruct
    options = preset(
        config.preset,
        forward=scene.ndc is not None,
        resolution=chosen.resolution,
        rays=chosen.rays,
        canonical_iterations=chosen.canonical_iterations,
        motion_iterations=chosen.motion_iterations,
        key_times=chosen.key_times,
        adapt=chosen.adapt,
        seed=chosen.seed,
    )
    return options
