"""When fixed cameras show the scene as the sweep shows it: at the start of their clips, at the end, between, or never.

Where something moves in a clip, the sweep's points look as in the sweep only while what moves is where it was then.
How many of a camera's points can be recognised at all is told by those where nothing moves. A camera with too few
points among what moves is asked whether its picture stands still instead: what is at rest need not move, but what
moves is not at rest.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.calibration.colour.sweep_points import SweepPoints, sweep_sightings
from devrf.capture.camera import Camera

Moment = Literal["start", "middle", "end", "none"]

MOMENTS = 7  # that are looked at: the start, the end, and five between; also the first and last that all cameras film
FEWEST = 20  # points to be recognised among what moves, before they tell anything
# Of the points that would be recognised if nothing had moved. In five captures 0.47 and more are at rest, and in motion
# mostly less than 0.3; before a small robot, whose points are few, up to 0.6.
AS_USUAL = 0.35
AS_BEST = 0.85  # of the most that are recognised at any moment


@dataclass(frozen=True)
class RestSeen:
    """What one camera tells.

    Attributes:
        expected: Points among what moves that would be recognised if nothing had moved.
        seen: How many of them are, at each moment: start, those between, end; None where it does not film.
        still: At the first and the last moment at which it films: whether next to nothing moves there.
    """

    expected: float
    seen: tuple[int | None, ...]
    still: tuple[bool, bool]

    @property
    def told_by_points(self) -> bool:
        """Whether there are enough of them."""
        return self.expected >= FEWEST

    @property
    def moments(self) -> Float[np.ndarray, " moments"]:
        """At which moments the camera shows the rest: 1, 0, or not a number where it does not film."""
        filmed = np.array([n is not None for n in self.seen])
        seen = np.array([n or 0 for n in self.seen], dtype=float)
        shown = seen >= max(AS_USUAL * self.expected, AS_BEST * float(seen.max()))
        if not self.told_by_points:
            shown[:] = False
            at = np.flatnonzero(filmed)
            shown[at[:1]], shown[at[-1:]] = self.still
        return np.where(filmed, shown.astype(float), np.nan)


def rest_seen(
    camera: Camera,
    pictures: Sequence[UInt8[np.ndarray, "h w 3"] | None],
    moves: Bool[np.ndarray, "mh mw"],
    still: tuple[bool, bool],
    sweep: SweepPoints,
) -> RestSeen:
    """Look for the sweep's points in one camera's pictures.

    Args:
        camera: As calibrated.
        pictures: At each moment, in the order of time; None where it does not film.
        moves: What moves in the clip, at any size.
        still: Whether next to nothing moves at the start and at the end.
        sweep: The points.
    """
    taken = [picture for picture in pictures if picture is not None]
    places, found = sweep_sightings(camera, taken, sweep)
    size = np.array(moves.shape[::-1])
    at = np.clip((places / [camera.width, camera.height] * size).astype(int), 0, size - 1)
    among = moves[at[:, 1], at[:, 0]]
    beside = found[:, ~among]
    usual = float(beside.mean()) if beside.size else 0.0
    counts = iter(found[:, among].sum(axis=1).tolist())
    seen = tuple(None if picture is None else int(next(counts)) for picture in pictures)
    return RestSeen(usual * float(among.sum()), seen, still)


def rest_votes(cameras: Sequence[RestSeen]) -> Float[np.ndarray, " moments"]:
    """Share of the cameras that show the rest at each moment; those that are told by points before others.

    Not a number where none of them films.
    """
    asked = [camera for camera in cameras if camera.told_by_points] or list(cameras)
    votes = np.stack([camera.moments for camera in asked])
    filmed = np.isfinite(votes).sum(axis=0)
    return np.where(filmed > 0, np.nansum(votes, axis=0) / np.maximum(filmed, 1), np.nan)


def moments_of(shared: tuple[float, float]) -> Float[np.ndarray, " moments"]:
    """Times in [0, 1] to look at, where all cameras film from `shared[0]` to `shared[1]`."""
    return np.unique(np.concatenate([np.linspace(0, 1, MOMENTS), np.clip(shared, 0, 1)]))


def rest_moment(
    times: Float[np.ndarray, " moments"], votes: Float[np.ndarray, " moments"], shared: tuple[float, float]
) -> tuple[Moment, float | None]:
    """When most cameras show the rest, and that time in [0, 1]; of moments at which somebody films.

    The start counts before the end, and both before what lies between: clips are meant to begin at rest. As long as
    the rest lasts, the time is the one at which the most cameras film: `shared[0]` or `shared[1]`.
    """
    shown = votes > 0.5
    if shown[0]:
        return "start", start_of(times, votes, shared)
    if shown[-1]:
        return "end", end_of(times, votes, shared)
    return ("middle", middle_of(times, votes)) if shown.any() else ("none", None)


def start_of(times: np.ndarray, votes: np.ndarray, shared: tuple[float, float]) -> float:
    """The last time up to `shared[0]` to which a rest at the start lasts."""
    lasting = np.cumprod(votes > 0.5).astype(bool) & (times <= max(shared[0], 0.0))
    return float(times[lasting][-1]) if lasting.any() else 0.0


def end_of(times: np.ndarray, votes: np.ndarray, shared: tuple[float, float]) -> float:
    """The first time from `shared[1]` on at which a rest at the end has begun."""
    return 1.0 - start_of(1 - times[::-1], votes[::-1], (1 - shared[1], 1 - shared[0]))


def middle_of(times: np.ndarray, votes: np.ndarray) -> float:
    """The time between start and end at which most cameras show the rest."""
    return float(times[1 + int(votes[1:-1].argmax())]) if len(times) > 2 else 0.5
