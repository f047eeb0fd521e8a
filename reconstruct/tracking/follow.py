"""Follow surface points through time, away from the moment of rest, to the end and to the beginning of the films.

They are followed by the nodes of a graph, and again with other clocks where points seem to show that a camera's is
wrong. Cameras that are left out in turn tell which tracks are better (`cross_validation.py`).
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from devrf.capture.system.cores import usable_cores
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.evaluation.paired import gain_text
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.tracking.cross_validation import CrossValidation
from devrf.reconstruct.tracking.follower import Follower
from devrf.reconstruct.tracking.offsets import Offsets, offsets_to_follow
from devrf.reconstruct.tracking.runs import Runs
from devrf.reconstruct.tracking.solver.graph import Graph
from devrf.reconstruct.tracking.views.film import CameraFilm

MOST_AGAIN = 2  # times that everything is followed with other clocks
SETTLED = 0.05  # of the time between moments: offsets that change by less are known
# Of a long clip not every picture is looked at. What is thrown leaves the straight way between moments by a centimetre
# where these are LONGEST_GAP_S apart, so longer clips have more of them.
MOST_MOMENTS, LONGEST_GAP_S = 300, 0.08


@dataclass(frozen=True)
class SurfaceTracks:
    """Where surface points are at moments.

    Attributes:
        times: Moments in the scene's time of [0, 1], rising and evenly spaced [t].
        xyz: Positions [t, p, 3], in the box frame.
        lost: Whether pictures show something else there [t, p]: the position is a guess.
        offsets: By how much later each film was taken than its times say, as it was followed, in the same time [c].
    """

    times: Float[np.ndarray, " t"]
    xyz: Float[np.ndarray, "t p 3"]
    lost: Bool[np.ndarray, "t p"]
    offsets: Float[np.ndarray, " c"]

    def only(self, kept: Bool[np.ndarray, " p"]) -> "SurfaceTracks":
        """Of some of the points."""
        return replace(self, xyz=self.xyz[:, kept], lost=self.lost[:, kept])


class _Following(NamedTuple):
    """Everything followed once.

    Attributes:
        tracks: Where points were found.
        seen: What that says of the offsets, by the sign of time.
        left_out: How well the tracks agree with pictures left out.
    """

    tracks: SurfaceTracks
    seen: dict[int, Offsets]
    left_out: CrossValidation


def follow_both_ways(
    graph: Graph,
    films: Sequence[CameraFilm],
    rest_time: float,
    progress: Callable[[float], object] = lambda share: None,
    checkpoint: Checkpoint = NOWHERE,
    log: TrainingLog | None = None,
) -> tuple[SurfaceTracks, list[Decision]]:
    """Follow points from the time of rest to the end and to the beginning of the films.

    Where they were followed with other clocks, too, the tracks with which pictures left out agree more, by more than
    chance, and what was decided.

    Args:
        graph: Of points that move.
        films: With what stands in them.
        rest_time: In [0, 1].
        progress: Told how much is done.
        checkpoint: Where to keep the state between two moments, and to take it up from.
        log: Counts the seconds, those before it was killed too.
    Raises:
        OutOfTime: The time for all is over; the state is kept.
    """
    times, before = moments(films, rest_time)
    gap = float(times[1] - times[0]) if len(times) > 1 else 1.0
    runs = Runs(checkpoint, len(graph.surface), log or TrainingLog("cpu", 1))
    task = _Task(graph, films, times, before, progress, runs)
    every = [task.both_ways(np.zeros(len(films)), 0)]
    while len(every) <= MOST_AGAIN:
        offsets = _but_sure_ones(offsets_to_follow([one.seen for one in every], gap), films)
        if np.abs(offsets - every[-1].tracks.offsets).max() < SETTLED * gap or not offsets.any():
            break
        every.append(task.both_ways(offsets, len(every)))
    runs.write()
    as_said, last = every[0], every[-1]
    if last is as_said:
        return as_said.tracks, []
    gain, moved = last.left_out.gain_over(as_said.left_out), _moved(films, last.tracks.offsets)
    reason = f"in cameras left out of tracking in turn moved ones gain {gain_text(gain, 'likeness')}"
    if gain.side() > 0:
        return last.tracks, [Decision("clocks", moved, "as they are", reason)]
    return as_said.tracks, [Decision("clocks", "as they are", moved, reason)]


@dataclass(frozen=True)
class _Task:
    """What is followed, again and again: as `follow_both_ways` takes it; `before`: moments before the time of rest."""

    graph: Graph
    films: Sequence[CameraFilm]
    times: Float[np.ndarray, " t"]
    before: int
    progress: Callable[[float], object]
    runs: Runs

    def both_ways(self, offsets: Float[np.ndarray, " c"], again: int) -> _Following:
        """From the moment of rest to the last and to the first; for how many times again."""
        there, here = (self._one_way(sign, offsets, again) for sign in (1, -1))
        xyz = np.stack([x.astype(np.float32) for x in (*here.past.xyz[:0:-1], *there.past.xyz)])
        lost = np.stack([self.graph.points_of(x) for x in (*here.past.lost[:0:-1], *there.past.lost)])
        seen = {1: there.offsets, -1: here.offsets}
        left_out = here.left_out.with_those_of(there.left_out)
        return _Following(SurfaceTracks(self.times, xyz, lost, offsets), seen, left_out)

    def _one_way(self, sign: int, offsets: Float[np.ndarray, " c"], again: int) -> Follower:
        """To the last moment, or with a negative sign to the first."""
        run = f"{f'{again} times again' if again else 'as said'}, {'forward' if sign > 0 else 'back'}"
        films, times, done = self.films, self.times[self.before :], 0
        if sign < 0:
            films, times = [film.backwards() for film in films], -self.times[self.before :: -1]
            done = len(self.times) - len(times)
        side_by_side = all(film.estimator.parallel for film in films)
        with ThreadPoolExecutor(min(len(films), usable_cores()) if side_by_side else 1) as pool:
            seen = Offsets(sign * offsets, self.graph.surface.xyz)
            follower = Follower(self.graph, films, times, seen, pool)
            begun = self.runs.of(run)
            if begun is not None:
                follower.take_up(begun)
            for moment in range(1, len(times)):
                if moment == follower.past.coming:
                    follower.go_on()
                    self.runs.moved_on(run, len(times) - 1 - moment, follower.state)
                self._tell((done + moment) / max(len(self.times) - 1, 1), again)
        return follower

    def _tell(self, share: float, again: int) -> None:
        """How much is done; where clocks may be moved, half of what is left each time, since more may follow."""
        if not all(film.sure for film in self.films):
            share = 1 - 0.5**again * (1 - 0.5 * share)
        self.progress(share)


def _but_sure_ones(offsets: Float[np.ndarray, " c"], films: Sequence[CameraFilm]) -> Float[np.ndarray, " c"]:
    """The offsets beside those of films whose clocks are known, which are 0.

    What tracks say of clocks is bias more than noise: a person who carries a cube before things that swing moved a
    clock by 77 ms that sound and geometry knew to 3 ms.
    """
    sure = np.array([film.sure for film in films])
    return np.where(sure, 0.0, offsets - np.median(offsets[sure])) if sure.any() else offsets


def _moved(films: Sequence[CameraFilm], offsets: Float[np.ndarray, " c"]) -> str:
    """Which cameras' clocks are moved, and by how much."""
    second = _second(films)
    unit, each = ("", offsets) if np.isinf(second) else (" ms", 1e3 * offsets / second)
    names = (film.frames[0].camera_name for film in films)
    return ", ".join(f"{name} {late:+.3g}{unit}" for name, late in zip(names, each, strict=True) if late)


def moments(films: Sequence[CameraFilm], rest_time: float) -> tuple[Float[np.ndarray, " t"], int]:
    """When points are looked for, and the number of the time of rest among them.

    As far apart as the pictures of the film that has most a second, or farther where that were too many.
    """
    gap = min(float(np.median(np.diff(film.times))) for film in films)
    last = max(float(film.times[-1]) for film in films)
    first = min(float(film.times[0]) for film in films)
    gap = max(gap, min((last - first) / MOST_MOMENTS, LONGEST_GAP_S * _second(films)))
    after, before = (
        max(0, int(np.ceil(span / gap - 1e-6))) for span in (last - rest_time, rest_time - first)
    )
    return rest_time + gap * np.arange(-before, after + 1), before


def _second(films: Sequence[CameraFilm]) -> float:
    """How long a second is in the scene's time; infinite for a data set whose times are no seconds."""
    longest = max(films, key=lambda film: np.ptp(film.times))
    first_s, last_s = longest.frames[0].time_s, longest.frames[-1].time_s
    if first_s is None or last_s is None:
        return np.inf
    return float(longest.times[-1] - longest.times[0]) / (last_s - first_s)
