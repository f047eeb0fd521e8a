"""The calibration that scene.yaml names (`calibration.rig.given`), read for the cameras of the capture."""

from collections.abc import Mapping
from pathlib import Path

from devrf.calibration.rigs.given import Given, read_given
from devrf.pipelines.config.scene import SceneConfig


def given_calibration(
    config: SceneConfig, scene_dir: Path, sizes: Mapping[str, tuple[int, int]]
) -> Given | None:
    """What the named file says; None where none is named.

    Args:
        sizes: Cameras of the capture in their order -> picture size of their clip, pixels.
    Raises:
        InputError, CaptureError: It cannot be read, or is for other cameras.
    """
    rig = config.calibration.rig
    if rig.given is None:
        return None
    if isinstance(rig.given, str):
        source = config.path(scene_dir, rig.given)
    else:
        source = {name: config.path(scene_dir, text) for name, text in rig.given.items()}
    return read_given(source, list(sizes), sizes, rig.given_unit, rig.known_distance_m)
