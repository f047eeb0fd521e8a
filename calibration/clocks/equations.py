"""Clocks from shared moments: weighted least squares over all pairs of cameras, with their loops closed.

true time = offset_s + (1 + 1e-6 drift_ppm) * file time, on the first camera's clock, whose own offset and
drift are 0. A moment that two clips share at file times f_a and f_b gives one equation
o_a + r_a f_a = o_b + r_b f_b.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, overload

import numpy as np
from jaxtyping import Float

PairCue = Literal["audio", "flash", "motion", "timestamps", "geometry"]
Cue = Literal["reference", "audio", "flash", "motion", "timestamps", "geometry", "none"]

DRIFT_PRIOR_PPM = 30.0  # standard deviation between consumer cameras (7 to 50 ppm are measured)
DRIFT_KNOWN_PPM = 10.0  # a drift is given only where it is known better than this
SURE = 0.5  # confidence of a clock that a cue made known
HELD_STD_S = 1e-6  # of a clock that is held: a thousandth of what the best cue says
OUTLIER_SIGMAS = 5.0
OUTLIER_S = {"audio": 1e-3}  # sound travels 0.34 m in 1 ms: less is no contradiction


@dataclass(frozen=True)
class Clock:
    """One camera's clock; where nothing else is said, one that is known exactly.

    Attributes:
        offset_s, drift_ppm: true time = offset_s + (1 + 1e-6 drift_ppm) * file time.
        std_s: Standard deviation of the true time in the middle of the clip.
        method: The cue it comes from.
        confidence: 0 (a guess) to 1.
        basis: Where the confidence comes from, in words.
    """

    offset_s: float
    drift_ppm: float
    std_s: float = 0.0
    method: Cue = "reference"
    confidence: float = 1.0
    basis: str = ""

    def heard_within(self, std_s: float) -> bool:
        """Whether sound gave it with such a standard deviation at most, or it is the one to which all others are."""
        return self.method == "reference" or (self.method == "audio" and self.std_s <= std_s)

    @overload
    def true_time(self, file_time_s: float) -> float: ...

    @overload
    def true_time(self, file_time_s: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]: ...

    def true_time(self, file_time_s: float | Float[np.ndarray, "*n"]) -> float | Float[np.ndarray, "*n"]:
        """True times of file times, seconds."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * file_time_s

    def file_time(self, true_time_s: float) -> float:
        """The inverse of `true_time`."""
        return (true_time_s - self.offset_s) / (1 + 1e-6 * self.drift_ppm)


@dataclass(frozen=True)
class Equation:
    """f_a in clip a and f_b in clip b are the same moment.

    Attributes:
        a, b: Cameras.
        a_s, b_s: File times of the moment in their clips.
        std_s: Standard deviation of `a_s - b_s`.
        cue: What showed it.
        quality: Sound: peak over the next one. Motion: correlation. Others: number of things that agree.
        accepted: Whether it is believed.
        guess: Not accepted, but more likely right than nothing.
        score: Motion: standard deviations from chance.
    """

    a: str
    b: str
    a_s: float
    b_s: float
    std_s: float
    cue: PairCue
    quality: float
    accepted: bool = True
    guess: bool = False
    score: float = 0.0

    @property
    def delay_s(self) -> float:
        """File time in a minus file time in b."""
        return self.a_s - self.b_s


@dataclass(frozen=True)
class ClockSolution:
    """Clocks of the cameras that are reached from the first one.

    Attributes:
        offset_s, drift_ppm: Camera -> clock; drifts that the data do not show are 0.
        std_s: Camera -> standard deviation in mid-clip.
        residual_s: Of each equation; 0 for those between cameras that are not reached [n].
    """

    offset_s: dict[str, float]
    drift_ppm: dict[str, float]
    std_s: dict[str, float]
    residual_s: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Loop:
    """How far the delays a to b, b to c and c to a are from adding up to nothing."""

    cameras: tuple[str, str, str]
    cue: PairCue
    closure_s: float


def held(clocks: Mapping[str, Clock], spans_s: Mapping[str, tuple[float, float]]) -> list[Equation]:
    """Equations that leave known clocks as they are: both ends of each clip, on the first one's clock.

    Args:
        clocks: The known ones, the reference first; those that a cue did not make sure stay guesses.
        spans_s: Camera -> (first, last) file time of its frames.
    """
    first, *others = clocks
    out = []
    for name in others:
        clock = clocks[name]
        sure = clock.confidence >= SURE
        cue: PairCue = clock.method if clock.method not in ("reference", "none") else "timestamps"
        for file_s, true_s in zip(
            spans_s[name], clock.true_time(np.array(spans_s[name])).tolist(), strict=True
        ):
            out.append(Equation(first, name, true_s, file_s, HELD_STD_S, cue, 1.0, sure, not sure))
    return out


def solve(spans_s: Mapping[str, tuple[float, float]], equations: Sequence[Equation]) -> ClockSolution:
    """Weighted least squares for offsets and drifts.

    Args:
        spans_s: Camera -> (first, last) file time of its frames; the first camera is the reference.
        equations: Shared moments; those of cameras that are not connected with the first one are ignored.
    """
    reached = [name for name in spans_s if name in reached_from_first(list(spans_s), equations)]
    free = reached[1:]
    inside = np.array([e.a in reached for e in equations], dtype=bool)
    equations = [e for e in equations if e.a in reached]
    x, cov, inner = _least_squares(reached, free, equations)
    known = [n for k, n in enumerate(free) if np.sqrt(cov[len(free) + k, len(free) + k]) <= DRIFT_KNOWN_PPM]
    if known != free:
        x, cov, inner = _least_squares(reached, known, equations)
    residual = np.zeros(len(inside))
    residual[inside] = inner
    offset, drift, std = {reached[0]: 0.0}, dict.fromkeys(reached, 0.0), {reached[0]: 0.0}
    for k, name in enumerate(free):
        from_s, to_s = spans_s[name]
        gradient = np.zeros(len(x))  # of the true time in mid-clip
        gradient[k] = 1.0
        unknown_s = 1e-6 * DRIFT_PRIOR_PPM * (to_s - from_s) / 2
        if name in known:
            d = len(free) + known.index(name)
            drift[name], gradient[d], unknown_s = float(x[d]), 1e-6 * (from_s + to_s) / 2, 0.0
        offset[name] = float(x[k])
        std[name] = float(np.hypot(np.sqrt(max(gradient @ cov @ gradient, 0.0)), unknown_s))
    return ClockSolution(offset, drift, std, residual)


def _least_squares(
    names: Sequence[str], drifting: Sequence[str], equations: Sequence[Equation]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m m"], Float[np.ndarray, " n"]]:
    """Offsets (s) of all but the first camera, then drifts (ppm) of `drifting`; covariance; residuals (s)."""
    column = {name: k for k, name in enumerate(names[1:])}
    drift_column = {name: len(column) + k for k, name in enumerate(drifting)}
    size = len(column) + len(drift_column)
    A, y, sigma = np.zeros((len(equations), size)), np.zeros(len(equations)), np.ones(len(equations))
    for k, e in enumerate(equations):
        y[k], sigma[k] = e.b_s - e.a_s, e.std_s
        for name, file_s, sign in ((e.a, e.a_s, 1.0), (e.b, e.b_s, -1.0)):
            if name in column:
                A[k, column[name]] = sign
            if name in drift_column:
                A[k, drift_column[name]] = sign * 1e-6 * file_s
    unit = np.ones(size)
    unit[: len(column)] = 1e-4  # solved in tenths of milliseconds and ppm, so that the scales are alike
    prior = np.diag([0.0] * len(column) + [1 / DRIFT_PRIOR_PPM] * len(drift_column))
    weighted = np.concatenate([A * unit / sigma[:, None], prior])
    x, *_ = np.linalg.lstsq(weighted, np.concatenate([y / sigma, np.zeros(size)]), rcond=None)
    residual = y - A @ (x * unit)
    spare = len(equations) - len(column)
    scatter = max(1.0, float(np.sqrt(np.sum((residual / sigma) ** 2) / spare))) if spare > 0 else 1.0
    cov = scatter**2 * np.linalg.inv(weighted.T @ weighted) * np.outer(unit, unit)
    return x * unit, cov, residual


def consistent(
    spans_s: Mapping[str, tuple[float, float]], equations: list[Equation]
) -> tuple[list[Equation], list[Equation]]:
    """Drop, one by one, the equation that contradicts the others most, as long as all stay connected.

    Returns:
        What is kept, and what was dropped.
    """
    names, dropped, kept = list(spans_s), [], list(equations)
    while len(kept) > 1:
        residual = np.abs(solve(spans_s, kept).residual_s)
        limit = np.array([max(OUTLIER_SIGMAS * e.std_s, OUTLIER_S.get(e.cue, 0.0)) for e in kept])
        worst = int(np.argmax(residual / limit))
        rest = kept[:worst] + kept[worst + 1 :]
        if residual[worst] <= limit[worst]:
            break
        if len(reached_from_first(names, rest)) < len(reached_from_first(names, kept)):
            break
        dropped.append(kept[worst])
        kept = rest
    return kept, dropped


def groups(names: Sequence[str], equations: Sequence[Equation]) -> dict[str, int]:
    """Camera -> number of the group that these equations connect it with."""
    group = {name: i for i, name in enumerate(names)}
    for e in equations:
        if group[e.a] != group[e.b]:
            old, new = group[e.b], group[e.a]
            group = {name: new if g == old else g for name, g in group.items()}
    return group


def reached_from_first(names: Sequence[str], equations: Sequence[Equation]) -> set[str]:
    """Cameras that these equations connect with the first one."""
    group = groups(names, equations)
    return {name for name in names if group[name] == group[names[0]]}


def loops(names: Sequence[str], equations: Sequence[Equation]) -> list[Loop]:
    """Closure of every triple of cameras whose three pairs were compared by one cue.

    Long clips are compared at several moments: each pair's delay is their weighted mean.
    """
    out = []
    cues: list[PairCue] = list(dict.fromkeys(e.cue for e in equations))
    for cue in cues:
        delays: dict[tuple[str, str], float] = {}
        for a, b in itertools.combinations(names, 2):
            own = [e for e in equations if e.cue == cue and {e.a, e.b} == {a, b}]
            if own:
                values = [e.delay_s if e.a == a else -e.delay_s for e in own]
                delays[a, b] = float(np.average(values, weights=[e.std_s**-2 for e in own]))
        for a, b, c in itertools.combinations(names, 3):
            if {(a, b), (b, c), (a, c)} <= set(delays):
                out.append(Loop((a, b, c), cue, delays[a, b] + delays[b, c] - delays[a, c]))
    return out
