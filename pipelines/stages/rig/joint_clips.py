"""The board before several cameras at once, as the stage `rig` needs it: views with times, and lenses."""

from dataclasses import dataclass

from devrf.calibration.boards.calibrate import BoardCalibration
from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import weak_intrinsics
from devrf.calibration.rigs.board_views import TimedView
from devrf.capture.frames import CameraFrames
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.pipelines.inputs.board_clips import BoardClips
from devrf.pipelines.run_folder.clocks import read_clocks


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
    clips: BoardClips, names: list[str], calibrated: dict[str, Intrinsics], progress: Progress = no_progress
) -> JointViews:
    """Search the joint clips of `names` for the board.

    Args:
        calibrated: Intrinsics from elsewhere (a clip of the camera's own, a given calibration).

    Raises:
        InputError: A joint clip is not of the size that its camera films.
        HealthError: The board is never seen by a camera, or too seldom to calibrate it.
    """
    frames, spec = clips.frames, clips.spec
    clocks = read_clocks(clips.run_dir, joint=True)
    views: dict[str, list[TimedView]] = {}
    start, known, own = dict(calibrated), dict(calibrated), {}
    for n, name in enumerate(names):
        entry = frames.joint[name]
        step = part(progress, n / len(names), 1 / len(names))
        seen = clips.search(name, entry, spec if n else None, step)
        spec = seen.spec  # one board: as the clip before settled it
        views[name] = _timed(seen.views, frames.cameras[entry], clocks.get(entry, Clock(0.0, 0.0)))
        if name not in calibrated:
            own[name] = seen.calibration
            start[name] = own[name].intrinsics
            known[name] = weak_intrinsics(own[name].intrinsics, frames.cameras[name].pixel_aspect)
    return JointViews(spec, views, start, known, own)


def _timed(seen: list[BoardView], clip: CameraFrames, clock: Clock) -> list[TimedView]:
    times = [frame.time_s for frame in clip.used if frame.file is not None]
    return [TimedView(v, clock.true_time(t)) for v in seen if (t := times[v.frame]) is not None]
