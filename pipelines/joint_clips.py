"""The board before several cameras at once, as the stage `rig` needs it: views with times, and lenses."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devrf.calibration.boards.calibrate import BoardCalibration, LensChoice, calibrate_intrinsics
from devrf.calibration.boards.find import BoardSpec, BoardView, find_board
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import weak_intrinsics
from devrf.calibration.rigs.board_views import TimedView
from devrf.capture.frames import CameraFrames, FrameSet
from devrf.pipelines.clocks import read_clocks


@dataclass(frozen=True)
class JointViews:
    """What the joint clips show.

    Attributes:
        spec: The settled board.
        views: Camera -> its views, on cam0's clock.
        start: Camera -> intrinsics to start from; known: what is known of them apart from these views.
        own: Camera -> its calibration from its joint clip, where it has no better one.
    """

    spec: BoardSpec
    views: dict[str, list[TimedView]]
    start: dict[str, Intrinsics]
    known: dict[str, Intrinsics]
    own: dict[str, BoardCalibration]


def read_joint_views(
    run_dir: Path,
    frames: FrameSet,
    names: list[str],
    spec: BoardSpec,
    calibrated: dict[str, Intrinsics],
    progress: Callable[[float, str], None],
    lens: LensChoice = "auto",
) -> JointViews:
    """Search the joint clips of `names` for the board.

    Args:
        calibrated: Intrinsics from elsewhere (a clip of the camera's own, a given calibration).
        lens: Lens model of the calibrations that are made.

    Raises:
        HealthError: The board is never seen by a camera, or too seldom to calibrate it.
    """
    clocks = read_clocks(run_dir / "sync" / "sync.json")
    views: dict[str, list[TimedView]] = {}
    start, known, own = dict(calibrated), dict(calibrated), {}
    for n, name in enumerate(names):
        entry = frames.joint[name]
        clip = frames.cameras[entry]
        label = f"{clip.source} of camera '{name}'"

        def step(fraction: float, message: str, n: int = n) -> None:
            progress((n + fraction) / len(names), message)

        seen, spec = find_board(label, files_of(run_dir, clip), spec, step)
        views[name] = _timed(seen, clip, clocks.get(entry, (0.0, 1.0)))
        if name not in calibrated:
            own[name] = calibrate_intrinsics(name, seen, spec, (clip.width, clip.height), lens)
            start[name] = own[name].intrinsics
            known[name] = weak_intrinsics(own[name].intrinsics)
    return JointViews(spec, views, start, known, own)


def files_of(run_dir: Path, camera: CameraFrames) -> list[Path]:
    """The pictures of a camera that ingest kept."""
    return [run_dir / "ingest" / frame.file for frame in camera.used if frame.file is not None]


def _timed(seen: list[BoardView], clip: CameraFrames, clock: tuple[float, float]) -> list[TimedView]:
    offset_s, rate = clock
    times = [frame.time_s for frame in clip.used if frame.file is not None]
    return [TimedView(v, offset_s + rate * t) for v in seen if (t := times[v.frame]) is not None]
