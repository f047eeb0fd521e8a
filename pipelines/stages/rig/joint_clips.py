"""The board before several cameras at once, as the stage `rig` needs it: views with times, and lenses."""

from dataclasses import dataclass, field

from devrf.calibration.boards.calibrate import BoardCalibration
from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.clocks.equations import Clock
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.board_route import weak_intrinsics
from devrf.calibration.rigs.board_views import TimedView
from devrf.capture.frames import CameraFrames
from devrf.capture.measure import ENOUGH_CAMERAS
from devrf.capture.system.errors import HealthError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.pipelines.health.board_rows import fits
from devrf.pipelines.inputs.board_clips import BoardClip, BoardClips
from devrf.pipelines.run_folder.clocks import read_clocks


@dataclass(frozen=True)
class JointViews:
    """What the joint clips show.

    Attributes:
        spec: The settled board.
        views: Camera -> its views, on cam0's clock.
        start: Camera -> intrinsics to start from; known: what is known of them apart from these views.
        own: Camera -> its calibration from its joint clip, where it has no better one.
        left_out: Camera whose joint clip says nothing of it -> why.
    """

    spec: BoardSpec
    views: dict[str, list[TimedView]]
    start: dict[str, Intrinsics]
    known: dict[str, Intrinsics]
    own: dict[str, BoardCalibration]
    left_out: dict[str, str] = field(default_factory=dict)


def read_joint_views(
    clips: BoardClips, names: list[str], calibrated: dict[str, Intrinsics], progress: Progress = no_progress
) -> JointViews:
    """Search the joint clips of `names` for the board.

    Args:
        calibrated: Intrinsics from elsewhere (a clip of the camera's own, a given calibration).

    Raises:
        InputError: A joint clip is not of the size that its camera films.
        HealthError: So many cameras never see the board, or not well enough to be calibrated, that too few are left.
    """
    frames, spec = clips.frames, clips.spec
    clocks = read_clocks(clips.run_dir, joint=True)
    views: dict[str, list[TimedView]] = {}
    start, known, own = dict(calibrated), dict(calibrated), {}
    lost: dict[str, HealthError] = {}
    for n, name in enumerate(names):
        entry = frames.joint[name]
        step = part(progress, n / len(names), 1 / len(names))
        try:
            seen = clips.search(name, entry, spec if views else None, step)
            if name not in calibrated:
                own[name] = _fitting(seen)
        except HealthError as error:
            lost[name] = error
            if len(names) - len(lost) < ENOUGH_CAMERAS:
                raise lost[next(iter(lost))] from None
            continue
        spec = seen.spec  # one board: as the clip before settled it
        views[name] = _timed(seen.views, frames.cameras[entry], clocks.get(entry, Clock(0.0, 0.0)))
        if name not in calibrated:
            start[name] = own[name].intrinsics
            known[name] = weak_intrinsics(own[name].intrinsics, frames.cameras[name].pixel_aspect)
    return JointViews(spec, views, start, known, own, {name: str(error) for name, error in lost.items()})


def _fitting(clip: BoardClip) -> BoardCalibration:
    """The calibration of a camera by its joint clip.

    Raises:
        HealthError: Too few views, or they do not fit.
    """
    if not fits(clip.calibration):
        text = f"camera '{clip.camera}': the board in its joint clip is {clip.calibration.rms_px:.1f} px off"
        raise HealthError("board-unfit", f"{text}; check squares, use a flat print, avoid motion blur")
    return clip.calibration


def _timed(seen: list[BoardView], clip: CameraFrames, clock: Clock) -> list[TimedView]:
    times = [frame.time_s for frame in clip.used if frame.file is not None]
    return [TimedView(v, clock.true_time(t)) for v in seen if (t := times[v.frame]) is not None]
