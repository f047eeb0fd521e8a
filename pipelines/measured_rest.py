"""When the moving clips show the scene as in the sweep, measured in a run's pictures: `capture.rest: auto`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from devrf.calibration.bounds import MotionMask
from devrf.calibration.rest_moment import (
    MOMENTS,
    RestSeen,
    middle_of,
    rest_moment,
    rest_seen,
    rest_votes,
)
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.picture_files import read_pixels
from devrf.capture.scene import PosedFrame
from devrf.capture.session import Rest
from devrf.capture.stillness import AT_REST, moving_share, smooth_grey
from devrf.pipelines.health.rows import HealthRow, note

CHECK = "scene at rest in the clips"
SUCCESSIVE = 4  # pictures, to see whether anything moves
WITHIN_GAPS = (
    1.5  # of a camera's pictures: clocks that run free have one within one of all times that they film
)
REMEDY = (
    "Let the fixed cameras run for a second before the action, or say in capture.rest when their clips show the "
    "scene as in the sweep."
)


def rest_time(
    asked: Rest,
    clips: Mapping[str, Sequence[PosedFrame]],
    masks: Mapping[str, MotionMask],
    model: SweepModel | None,
    factor: float,
    ingest: Path,
) -> tuple[float | None, HealthRow]:
    """The time of rest in [0, 1], None without one; and what was seen.

    Args:
        asked: What scene.yaml says.
        clips: Training cameras: their pictures in the order of time, two or more.
        masks: What moves in each.
        model: The sweep; without one nothing is measured.
        factor: From the sweep's unit to the cameras'.
        ingest: Folder of that stage.
    """

    def read(name: str) -> np.ndarray:
        return read_pixels(ingest / "frames" / name)[..., :3]

    if model is None or not clips:
        return {"end": 1.0, "middle": 0.5, "none": None}.get(asked, 0.0), note(CHECK, "not measured")
    seen = {name: _seen(clip, masks[name], model, factor, read) for name, clip in clips.items()}
    votes = rest_votes(list(seen.values()))
    moment, time = rest_moment(votes)
    if asked != "auto":
        time = {"start": 0.0, "end": 1.0, "none": None}.get(asked, middle_of(votes))
    told = "; ".join(f"{name} {_told(camera)}" for name, camera in seen.items())
    found = "at no moment" if moment == "none" else f"at the {moment}"
    doubtful = moment == "none" if asked == "auto" else asked != "none" and _vote(votes, time) <= 0.5
    said = "" if asked in ("auto", moment) else f", capture.rest says {asked}"
    return time, note(CHECK, f"{found}{said}; {told}", remedy=REMEDY if doubtful else "")


def _seen(
    clip: Sequence[PosedFrame],
    mask: MotionMask,
    model: SweepModel,
    factor: float,
    read: Callable[[str], np.ndarray],
) -> RestSeen:
    times = np.array([frame.time for frame in clip], dtype=float)
    longest = WITHIN_GAPS * float(np.median(np.diff(times)))

    def picture(time: float) -> np.ndarray | None:
        n = int(np.abs(times - time).argmin())
        return read_pixels(clip[n].path)[..., :3] if abs(times[n] - time) <= longest else None

    pictures = [picture(time) for time in np.linspace(0, 1, MOMENTS)]
    still = (_still(clip[:SUCCESSIVE]), _still(clip[-SUCCESSIVE:]))
    return rest_seen(clip[0].camera, pictures, mask.mask, still, model, factor, read)


def _still(clip: Sequence[PosedFrame]) -> bool:
    share = moving_share([smooth_grey(read_pixels(frame.path)[..., :3]) for frame in clip])
    return share is not None and share <= AT_REST


def _told(camera: RestSeen) -> str:
    if not camera.told_by_points:
        ends = " and ".join(end for end, still in zip(("start", "end"), camera.still, strict=True) if still)
        return f"stands still at {ends or 'neither end'} (too few points among what moves)"
    shares = ("–" if n is None else f"{round(100 * n / camera.expected)}" for n in camera.seen)
    return f"recognises {', '.join(shares)} % from start to end"


def _vote(votes: np.ndarray, time: float | None) -> float:
    return 1.0 if time is None else float(votes[round(time * (len(votes) - 1))])
