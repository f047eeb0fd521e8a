"""Look at every raw file before anything starts, so that a wrong clip is found now and not after an hour."""

from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.session import CaptureSession
from devrf.pipelines.scene_config import SceneConfig

if TYPE_CHECKING:
    from devrf.capture.scene import Scene


def capture_session(config: SceneConfig, scene_dir: Path) -> CaptureSession:
    """The raw files that a configuration names, as absolute paths.

    Raises:
        ValueError: The configuration has no `capture`.
    """
    capture = config.capture
    if capture is None:
        raise ValueError("a data set has no raw files; expected a configuration with capture")

    def paths(clips: dict[str, str]) -> dict[str, Path]:
        return {name: config.path(scene_dir, clip) for name, clip in clips.items()}

    board = capture.board
    return CaptureSession(
        static=None if capture.static is None else config.path(scene_dir, capture.static),
        cameras=paths(capture.all_cameras),
        test_names=capture.test_names,
        timestamps=None if capture.timestamps is None else config.path(scene_dir, capture.timestamps),
        board_clips=paths(board.clips) if board else {},
        joint_clips=paths(board.joint_clips) if board else {},
        range_s=capture.range_s,
        rest=capture.rest,
    )


def configured_dataset(config: SceneConfig, scene_dir: Path, notes: list[str] | None = None) -> "Scene":
    """The data set that a configuration names.

    Args:
        config: The configuration.
        scene_dir: Folder of scene.yaml.
        notes: What was repaired or left out is added here, in words.
    Raises:
        ValueError: The configuration has no `dataset`.
        CaptureError: The data set cannot be used.
    """
    from devrf.capture.formats import read_dataset
    from devrf.capture.scene import background_of

    data = config.dataset
    if data is None:
        raise ValueError("a capture is no data set; expected a configuration with dataset")
    background = data.background
    if background == "auto":
        background = None
    elif not isinstance(background, str):
        background = background_of(background)
    folder, every = config.path(scene_dir, data.path), config.evaluate.holdout_every
    return read_dataset(data.format, folder, data.frame_stride, every, background, notes)


def check_raw_files(config: SceneConfig, scene_dir: Path) -> list[str]:
    """Everything that is wrong with the raw files or the data set; empty when all is well."""
    if config.dataset is None:
        from devrf.capture.session import preflight

        return preflight(capture_session(config, scene_dir))
    from devrf.capture.errors import DevrfError

    try:
        configured_dataset(config, scene_dir)
    except DevrfError as error:
        return [f"dataset: {error}"]
    return []
