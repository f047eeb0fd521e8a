"""The calibration that scene.yaml names (`calibration.rig.given`), read for the cameras of the capture."""

from collections.abc import Mapping
from pathlib import Path

from devrf.calibration.rigs.given import Given, read_given
from devrf.capture.frames import CameraFrames
from devrf.capture.video.reader import VideoInfo
from devrf.pipelines.config.scene import SceneConfig


def given_calibration(
    config: SceneConfig, scene_dir: Path, clips: Mapping[str, CameraFrames | VideoInfo]
) -> Given | None:
    """What the named file says; None where none is named.

    Args:
        clips: Cameras of the capture in their order -> what is known of their pictures.
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
    sizes = {name: (clip.width, clip.height) for name, clip in clips.items()}
    return read_given(source, list(sizes), sizes, rig.given_unit, rig.known_distance_m, clips)
