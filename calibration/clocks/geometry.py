"""Clocks checked by geometry once cameras are known: the epipolar error against trial offset.

Every picture carries its time by the clocks to be checked. Two cameras' pictures of what moves obey the
epipolar constraint where trial times agree; so the error must be smallest at a trial offset of 0, and clearly
so. Cameras that see the same side of the subject are compared by tracks of common points
(`epipolar_tracks`, good to a few hundredths of a frame), the others by the motion in each epipolar plane
(`epipolar_motion`, half a frame).
"""

import itertools
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.epipolar_motion import TimedPictures, accepted, clip_flow, epipolar_motion_delay
from devrf.calibration.clocks.epipolar_tracks import TrackDelay, TrackFinder, track_delay
from devrf.calibration.clocks.equations import Clock, ClockSolution, Equation, Loop, consistent, loops, solve
from devrf.calibration.clocks.motion import MotionDelay
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.progress import Progress, no_progress

COARSE_MOMENTS, FINE_MOMENTS = 6, 12  # of the wide and the narrow search for common points
FINE_SEARCH_FRAMES = 1.5  # short tracks are lost less often
SEARCH_FRAMES = 3.0  # around the clocks' own statement; in-camera lags are one to three frames
SEARCH_SIGMAS = 3.0
LARGEST_SEARCH_FRAMES = 6.0
FLAT_FRAMES = 0.5  # a minimum that is not known better than this many frames shows nothing
SHIFT_FRAMES = 0.25  # a minimum farther from 0 than this is no rounding
SHIFT_SIGMAS = 3.0
SURE_S = 1e-3  # standard deviation by sound, and its largest contradiction, at which two pairs of cameras are enough
SHARP_CONFIDENCE = 0.9
GUESS_CONFIDENCE = 0.5  # below, a cue was refused and its own standard deviation says nothing
LEAST_STD_S = 1e-4  # of a clock that is held
BETTER = 0.5  # geometry replaces a clock only where its standard deviation is at most half as large
# What a guess by motion energies is good for, in its own standard deviations and at least (docs/accuracy.md)
GUESS_SIGMAS, GUESS_STD_S = 2.0, 0.1

Method = Literal["tracks", "planes"]


@dataclass(frozen=True)
class PairCheck:
    """Two cameras compared.

    Attributes:
        first, second: Cameras.
        by: Tracks of common points, or the motion in epipolar planes.
        offset_s: Where the error is smallest: what the second camera's times must be raised by.
        std_s: Its standard deviation.
        sharp: Whether the minimum is known to half a frame.
        shifted: Whether it is not 0, as of a correction.
        lags_s, values: The curve [n]: mean error, pixels (tracks), or correlation (planes).
    """

    first: str
    second: str
    by: Method
    offset_s: float
    std_s: float
    sharp: bool
    shifted: bool
    lags_s: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class ClockCorrection:
    """What geometry says of one clock.

    Attributes:
        offset_s: What must be added to the camera's times, seconds.
        std_s: Its standard deviation.
        sharp: Whether it is known to half a frame.
        shifted: Whether it is not 0 (beyond a quarter of a frame and three standard deviations).
    """

    offset_s: float
    std_s: float
    sharp: bool
    shifted: bool


@dataclass(frozen=True)
class GeometryCheck:
    """The check of all clocks.

    Attributes:
        pairs: Of cameras.
        corrections: By geometry alone, of the cameras that pairs reach, but not the first.
        held: The same with the clocks held that a cue makes known, and with guesses for what they are worth: what the
            others are to be corrected by. A camera may be well known beside its neighbours, and all of them badly
            beside the first.
        loops, notes: Sums around triangles; what could not be seen.
    """

    pairs: tuple[PairCheck, ...]
    corrections: dict[str, ClockCorrection]
    held: dict[str, ClockCorrection]
    loops: tuple[Loop, ...]
    notes: tuple[str, ...]


def check_clocks(
    views: Mapping[str, TimedPictures],
    clocks: Mapping[str, Clock],
    progress: Progress = no_progress,
    known: Collection[str] = (),
    loop_s: float | None = None,
) -> GeometryCheck:
    """Compare pairs of cameras: each camera with one other where sound is sure, and all where it or they are not.

    Args:
        views: Camera -> camera and pictures, whose times are those of the clocks to be checked.
        clocks: The clocks, for how sure they are.
        progress: Called after each pair; pairs are compared side by side.
        known: Cameras whose clocks stand: the others are compared with these, and these not with each other.
        loop_s: Largest contradiction between the pairs that gave the clocks; None: there was none to be seen.
    """
    asked = {n: clocks[n] for n in views if n not in known}
    if loop_s is not None and loop_s <= SURE_S and all(map(_heard_surely, asked.values())):
        few = _once_each(list(views), known)
        alone = {n: view for n, view in views.items() if any(n in pair for pair in few)}
        check = _compared(alone, clocks, few, progress, known)
        sharp = {(p.first, p.second) for p in check.pairs if p.sharp}
        if sharp == set(few) and not any(c.shifted for c in check.corrections.values()):
            return check
    every = [pair for pair in itertools.combinations(views, 2) if not set(pair) <= set(known)]
    return _compared(views, clocks, every, progress, known)


def _heard_surely(clock: Clock) -> bool:
    return clock.heard_within(SURE_S) and not _guessed(clock)


def _once_each(names: Sequence[str], known: Collection[str]) -> list[tuple[str, str]]:
    """Pairs in which each camera is once, of an odd number one twice; with `known` ones, each other one with two."""
    stand = [n for n in names if n in known]
    if stand:
        return [
            (a, b) if names.index(a) < names.index(b) else (b, a)
            for b in names
            if b not in known
            for a in stand[:2]
        ]
    pairs = list(zip(names[::2], names[1::2], strict=False))
    return pairs if len(names) % 2 == 0 else [*pairs, (names[0], names[-1])]


def _compared(
    views: Mapping[str, TimedPictures],
    clocks: Mapping[str, Clock],
    combinations: Sequence[tuple[str, str]],
    progress: Progress,
    known: Collection[str],
) -> GeometryCheck:
    """What these pairs say; of cameras that no chain of pairs connects with the first one, one stands."""
    names = list(views)
    spans = {n: (float(v.time_s[0]), float(v.time_s[-1])) for n, v in views.items()}
    work = _Work(views)
    stand = [n for n in names if n in known] or _first_of_groups(names, combinations)
    firm = [Equation(stand[0], n, 0.0, 0.0, LEAST_STD_S, "geometry", 1.0) for n in stand[1:]]
    planes, pairs = {}, {}

    def widely(pair: tuple[str, str]) -> tuple[PairCheck | None, PairCheck | None]:
        by_planes = work.planes(*pair)
        unsure_s = float(np.hypot(clocks[pair[0]].std_s, clocks[pair[1]].std_s))
        return by_planes, work.wide_search(*pair, by_planes, unsure_s)

    with ThreadPoolExecutor(usable_cores()) as pool:  # following points lets other threads run
        for i, (pair, of_pair) in enumerate(zip(combinations, pool.map(widely, combinations), strict=True)):
            progress(0.5 * (i + 1) / len(combinations), "geometry of " + " and ".join(pair))
            planes[pair], tracks = of_pair
            pairs[pair] = _better(tracks, planes[pair])
        found = _solve(spans, pairs, firm)[0].offset_s
        reached = [(a, b) for a, b in combinations if a in found and b in found]
        narrowly = pool.map(lambda pair: work.narrow_search(pair[0], pair[1], found), reached)
        for i, (pair, tracks) in enumerate(zip(reached, narrowly, strict=True)):
            progress(0.5 + 0.5 * (i + 1) / len(reached), "geometry of " + " and ".join(pair))
            if tracks is not None:
                pairs[pair] = _better(tracks, planes[pair])
    solution, kept, dropped = _solve(spans, pairs, firm)
    notes = [
        f"{a} and {b}: not observable, nothing moves in both across epipolar lines"
        for (a, b), p in pairs.items()
        if p is None
    ]
    notes += [
        f"{a} and {b}: not observable, what moves there moves along epipolar lines"
        for (a, b), p in pairs.items()
        if p is not None and not p.sharp
    ]
    notes += [f"{e.a} and {e.b}: geometry contradicts the other pairs; dropped" for e in dropped]
    worth_s = {n: guess_std_s(c) if _replaceable(c) else max(c.std_s, LEAST_STD_S) for n, c in clocks.items()}
    said = [
        Equation(names[0], n, 0.0, 0.0, worth_s[n], "geometry", 1.0)
        for n in names[1:]
        if np.isfinite(worth_s[n]) and n not in known
    ]

    seen = {n for e in kept for n in (e.a, e.b)}

    def corrections(by: ClockSolution) -> dict[str, ClockCorrection]:
        asked = (n for n in names[1:] if n in by.offset_s and n in seen and n not in known)
        return {n: _correction(by.offset_s[n], by.std_s[n], work.step_s(n)) for n in asked}

    checked = tuple(p for p in pairs.values() if p is not None)
    held = corrections(solve(spans, [*kept, *said]))
    return GeometryCheck(checked, corrections(solution), held, tuple(loops(names, kept)), tuple(notes))


def _first_of_groups(names: Sequence[str], pairs: Sequence[tuple[str, str]]) -> list[str]:
    """Of each group of cameras that pairs connect the first."""
    group = {n: n for n in names}
    for a, b in pairs:
        one, other = group[a], group[b]
        group = {n: one if g == other else g for n, g in group.items()}
    return [n for n in names if n in set(group.values())]


def refined(clocks: Mapping[str, Clock], check: GeometryCheck) -> dict[str, Clock]:
    """The clocks that motion, a guess or nothing gave, replaced where geometry is much surer.

    It must be sharp, too, unless there is nothing it could be worse than.
    """
    out = dict(clocks)
    for name, correction in check.held.items():
        clock = clocks[name]
        std_s = np.inf if _guessed(clock) else clock.std_s
        surer = correction.std_s <= BETTER * std_s
        enough = correction.sharp or not np.isfinite(std_s)
        if _replaceable(clock) and enough and surer:
            out[name] = Clock(
                clock.offset_s + correction.offset_s,
                clock.drift_ppm,
                correction.std_s,
                "geometry",
                max(clock.confidence, SHARP_CONFIDENCE if correction.sharp else 0.5),
                f"epipolar error smallest {1e3 * correction.offset_s:+.1f} ms from the clock by {clock.method}",
            )
    return out


def guess_std_s(clock: Clock) -> float:
    """Standard deviation of a clock that motion energies guess; infinite for every other clock."""
    guessed = _guessed(clock) and clock.method == "motion"
    return max(GUESS_SIGMAS * clock.std_s, GUESS_STD_S) if guessed else np.inf


def _replaceable(clock: Clock) -> bool:
    if clock.method == "reference" or clock.std_s == 0:  # taken as true
        return False
    return _guessed(clock) or clock.method in ("motion", "timestamps")


def _guessed(clock: Clock) -> bool:
    return clock.confidence < GUESS_CONFIDENCE


class _Work:
    """What is computed once for each camera, and the comparisons of two."""

    def __init__(self, views: Mapping[str, TimedPictures]) -> None:
        self.finders = {name: TrackFinder(view) for name, view in views.items()}
        with ThreadPoolExecutor(usable_cores()) as pool:
            self.flows = dict(zip(views, pool.map(clip_flow, views.values()), strict=True))
        self._speeds = {n: np.abs(flow.flow).mean(axis=(1, 2, 3)) for n, flow in self.flows.items()}
        self._from_s = max(float(v.time_s[0]) for v in views.values())
        self._to_s = min(float(v.time_s[-1]) for v in views.values())

    def step_s(self, *names: str) -> float:
        """The longest frame step of these cameras."""
        return max(self.finders[name].step_s for name in names)

    def planes(self, a: str, b: str) -> PairCheck | None:
        """By the motion in epipolar planes, at any delay; None where no delay stands out."""
        found = epipolar_motion_delay(self.flows[a], self.flows[b])
        if found is None or not accepted(found):
            return None
        return self._pair((a, b), "planes", found, found.values, 2 * FLAT_FRAMES)  # half a frame is its floor

    def wide_search(self, a: str, b: str, planes: PairCheck | None, unsure_s: float) -> PairCheck | None:
        """By tracks near what the clocks say, and near what the planes say where that is elsewhere."""
        step_s = self.step_s(a, b)
        frames = np.clip(SEARCH_SIGMAS * unsure_s / step_s, SEARCH_FRAMES, LARGEST_SEARCH_FRAMES)
        search_s = float(frames) * step_s
        centres = [0.0]
        if planes is not None and abs(planes.offset_s) > search_s / 2:
            centres.append(planes.offset_s)
        tried = [self._tracks(a, b, {a: 0.0, b: c}, search_s, COARSE_MOMENTS) for c in centres]
        return min((t for t in tried if t is not None), key=lambda t: float(t.values.min()), default=None)

    def narrow_search(self, a: str, b: str, offset_s: Mapping[str, float]) -> PairCheck | None:
        """By tracks near what all pairs together say."""
        return self._tracks(a, b, offset_s, FINE_SEARCH_FRAMES * self.step_s(a, b), FINE_MOMENTS)

    def _tracks(
        self, a: str, b: str, offset_s: Mapping[str, float], search_s: float, count: int
    ) -> PairCheck | None:
        moments = [(t - offset_s[a], t - offset_s[b]) for t in self._moments_s(count, search_s)]
        around_s = offset_s[b] - offset_s[a]
        found = track_delay(self.finders[a], self.finders[b], moments, around_s, search_s)
        if found is None:
            return None
        return self._pair((a, b), "tracks", found, found.error_px, FLAT_FRAMES)

    def _pair(
        self,
        pair: tuple[str, str],
        by: Method,
        found: MotionDelay | TrackDelay,
        values: Float[np.ndarray, " n"],
        flat_frames: float,
    ) -> PairCheck:
        step_s = self.step_s(*pair)
        sharp = found.std_s <= flat_frames * step_s
        shifted = _shifted(found.delay_s, found.std_s, step_s)
        return PairCheck(*pair, by, found.delay_s, found.std_s, sharp, shifted, found.lags_s, values)

    def _moments_s(self, count: int, margin_s: float) -> list[float]:
        """Times that share out evenly what moves in all cameras; the same for all, so that points are found once."""
        grid = np.linspace(self._from_s + margin_s, self._to_s - margin_s, 256)
        if grid[0] >= grid[-1]:
            return []
        moved = np.zeros(len(grid))
        for name, speed in self._speeds.items():
            moved += np.interp(grid, self.flows[name].time_s, speed) / max(float(speed.max()), 1e-9)
        share = np.cumsum(np.maximum(moved - 0.5 * np.median(moved), 0.0))
        wanted = (np.arange(count) + 0.5) / count * share[-1]
        return [float(t) for t in np.unique(grid[np.searchsorted(share, wanted).clip(max=len(grid) - 1)])]


def _better(tracks: PairCheck | None, planes: PairCheck | None) -> PairCheck | None:
    if tracks is None or planes is None:
        return tracks or planes
    return tracks if tracks.std_s < planes.std_s else planes


def _solve(
    spans: Mapping[str, tuple[float, float]],
    pairs: Mapping[tuple[str, str], PairCheck | None],
    firm: Sequence[Equation],
) -> tuple[ClockSolution, list[Equation], list[Equation]]:
    """What each camera's times must be raised by; the pairs that agree, and those that do not.

    `firm`: of clocks that stand.
    """
    equations = [
        *firm,
        *(
            Equation(p.first, p.second, p.offset_s, 0.0, p.std_s, "geometry", 1.0)
            for p in pairs.values()
            if p is not None
        ),
    ]
    kept, dropped = consistent(spans, equations)
    return solve(spans, kept), kept, dropped


def _correction(offset_s: float, std_s: float, step_s: float) -> ClockCorrection:
    return ClockCorrection(offset_s, std_s, std_s <= FLAT_FRAMES * step_s, _shifted(offset_s, std_s, step_s))


def _shifted(offset_s: float, std_s: float, step_s: float) -> bool:
    return abs(offset_s) > max(SHIFT_FRAMES * step_s, SHIFT_SIGMAS * std_s)
