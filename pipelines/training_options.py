"""What scene.yaml says about training, as the reconstruction's own options."""

from typing import TYPE_CHECKING

from devrf.pipelines.scene_config import SceneConfig

if TYPE_CHECKING:
    from devrf.reconstruct.options import Options


def training_options(config: SceneConfig) -> "Options":
    """The preset with what the file overrides."""
    from devrf.reconstruct.options import preset

    chosen = config.reconstruct
    return preset(
        config.preset,
        resolution=chosen.resolution,
        rays=chosen.rays,
        canonical_iterations=chosen.canonical_iterations,
        motion_iterations=chosen.motion_iterations,
        seed=chosen.seed,
    )
