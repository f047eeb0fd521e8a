"""What scene.yaml says about raw files, as a `CaptureSession`."""

from pathlib import Path

from devrf.capture.frames import SWEEP
from devrf.capture.session import CaptureSession
from devrf.pipelines.config.scene import SceneConfig


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
        white_balance=None if capture.raw.white_balance == "auto" else capture.raw.white_balance,
        range_s=capture.range_s,
        rest=capture.rest,
    )


def raw_file(config: SceneConfig, scene_dir: Path, camera: str) -> Path:
    """The clip, or folder of photos, of a camera or of the sweep; since ingest it may have been renamed."""
    capture = config.capture
    assert capture is not None
    name = capture.static if camera == SWEEP else capture.all_cameras[camera]
    assert name is not None
    return config.path(scene_dir, name)
