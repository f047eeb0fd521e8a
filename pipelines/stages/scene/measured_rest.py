"""When the moving clips show the scene as in the sweep, measured in a run's pictures: `capture.rest: auto`."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.calibration.colour.sweep_points import SweepPoints
from devrf.calibration.extent.motion_masks import MotionMask
from devrf.calibration.extent.rest_moment import (
    RestSeen,
    middle_of,
    moments_of,
    rest_moment,
    rest_seen,
    rest_votes,
)
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.ingest.stillness import AT_REST, moving_share, smooth_grey
from devrf.capture.measure import Measure
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.rest import Rest
from devrf.capture.scene import PosedFrame

SUCCESSIVE = 4  # pictures, to see whether anything moves
LATEST = 0.25  # of the time: a camera that begins to film later does not see a rest that scene.yaml puts at the start
WITHIN_GAPS = 1.5  # of a camera's pictures: it films whenever one is no farther away


def rest_time(
    asked: Rest,
    clips: Mapping[str, Sequence[PosedFrame]],
    masks: Mapping[str, MotionMask],
    shared: tuple[float, float],
    sweep: tuple[SweepModel, float] | None,
    ingest: Path,
) -> tuple[float | None, list[Measure]]:
    """The time of rest in [0, 1], None without one; and what was seen, if anything was looked at.

    Args:
        asked: What scene.yaml says.
        clips: Training cameras: their pictures in the order of time, two or more.
        masks: What moves in each.
        shared: The first and the last time at which all of these film, in [0, 1].
        sweep: It and the factor from its unit to the cameras'; without one nothing is measured.
        ingest: Folder of that stage.
    """

    def read(name: str) -> np.ndarray:
        return read_pixels(ingest / "frames" / name)[..., :3]

    begin = shared[0] if shared[0] <= LATEST else 0.0
    end = shared[1] if shared[1] >= 1 - LATEST else 1.0
    said = {"end": end, "middle": 0.5, "none": None}.get(asked, begin)
    if sweep is None or not clips:
        return said, []
    times = moments_of(shared)
    points = SweepPoints(*sweep, read)
    seen = {name: _seen(clip, times, masks[name], points) for name, clip in clips.items()}
    votes = rest_votes(list(seen.values()))
    times, votes = times[np.isfinite(votes)], votes[np.isfinite(votes)]
    moment, time = rest_moment(times, votes, shared)
    if asked != "auto":
        time = middle_of(times, votes) if asked == "middle" else said
    told = "; ".join(f"{name} {_told(camera)}" for name, camera in seen.items())
    found = "at no moment" if moment == "none" else f"at the {moment}"
    nobody = time is not None and votes[np.abs(times - time).argmin()] == 0
    doubtful = nobody or (asked == "auto" and time is None)
    against = "" if asked in ("auto", moment) else f", capture.rest says {asked}"
    verdict = "warn" if doubtful else "ok"
    return time, [Measure("rest-unseen", f"{found}{against}; {told}", why="never", found=verdict)]


def _seen(
    clip: Sequence[PosedFrame],
    moments: Float[np.ndarray, " moments"],
    mask: MotionMask,
    sweep: SweepPoints,
) -> RestSeen:
    times = np.array([frame.time for frame in clip], dtype=float)
    longest = WITHIN_GAPS * float(np.median(np.diff(times)))

    def picture(time: float) -> np.ndarray | None:
        n = int(np.abs(times - time).argmin())
        return read_pixels(clip[n].path)[..., :3] if abs(times[n] - time) <= longest else None

    pictures = [picture(time) for time in moments]
    still = (_still(clip[:SUCCESSIVE]), _still(clip[-SUCCESSIVE:]))
    moves = mask.mask if mask.much is None else mask.much
    return rest_seen(clip[0].camera, pictures, moves, still, sweep)


def _still(clip: Sequence[PosedFrame]) -> bool:
    share = moving_share([smooth_grey(read_pixels(frame.path)[..., :3]) for frame in clip])
    return share is not None and share <= AT_REST


def _told(camera: RestSeen) -> str:
    if not camera.told_by_points:
        ends = " and ".join(end for end, still in zip(("start", "end"), camera.still, strict=True) if still)
        return f"stands still at {ends or 'neither end'} (too few points among what moves)"
    shares = ("–" if n is None else f"{round(100 * n / camera.expected)}" for n in camera.seen)
    return f"recognises {', '.join(shares)} % from start to end"
