"""Every camera's clock from what the cameras heard or saw together.

true time = offset_s + (1 + 1e-6 drift_ppm) * file time, on the first camera's clock, whose own offset and
drift are 0. Every pair of cameras is compared (`sync_sound`, `sync_motion`); a moment that two clips share
at file times f_a and f_b gives one equation o_a + r_a f_a = o_b + r_b f_b; all together are solved by
weighted least squares, so a pair that contradicts the others shows (loop error) and is dropped.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.calibration.sync_motion import ACCEPT_CORRELATION, ACCEPT_SCORE, MotionDelay, motion_delay
from devrf.calibration.sync_sound import ACCEPT_RATIO, sound_delay
from devrf.capture.audio import Sound
from devrf.capture.errors import CalibrationError
from devrf.capture.progress import Progress, no_progress

Method = Literal["auto", "audio", "motion", "timestamps", "none"]
Cue = Literal["reference", "audio", "motion", "timestamps", "none"]

DRIFT_PRIOR_PPM = 30.0  # standard deviation between consumer cameras (7 to 50 ppm are measured)
DRIFT_KNOWN_PPM = 10.0  # a drift is given only where it is known better than this
GUESS_RATIO = 1.5  # a refused cue this good is still taken as a guess, with a confidence below one half
GUESS_SCORE = 2.0
OUTLIER_SIGMAS = 5.0
OUTLIER_S = {"audio": 1e-3, "motion": 0.0}  # sound travels 0.34 m in 1 ms: less is no contradiction
SOUND_PATH_S_PER_M = 1 / 343.0


@dataclass(frozen=True)
class Clock:
    """One camera's clock.

    Attributes:
        offset_s, drift_ppm: true time = offset_s + (1 + 1e-6 drift_ppm) * file time.
        std_s: Standard deviation of the true time in the middle of the clip.
        method: The cue it comes from.
        confidence: 0 (a guess) to 1.
        basis: Where the confidence comes from, in words.
    """

    offset_s: float
    drift_ppm: float
    std_s: float
    method: Cue
    confidence: float
    basis: str

    def true_time(self, file_time_s: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """True times of file times, seconds."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * file_time_s


@dataclass(frozen=True)
class Curve:
    """How well two cameras agree at each lag: what the decision was taken from."""

    first: str
    second: str
    method: Literal["audio", "motion"]
    delay_s: float
    quality: float
    accepted: bool
    lags_s: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class SyncResult:
    """Clocks of all cameras, and what they were taken from.

    Attributes:
        cameras: Name -> clock; the first is the reference.
        curves: One per compared pair and cue.
        loop_s: Largest disagreement of a pair with the solution, seconds; None without spare pairs.
        notes: What was decided and why, one sentence each.
    """

    cameras: dict[str, Clock]
    curves: tuple[Curve, ...] = ()
    loop_s: float | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Equation:
    """f_a in clip a and f_b in clip b are the same moment."""

    a: str
    b: str
    a_s: float
    b_s: float
    std_s: float
    cue: Literal["audio", "motion"]
    quality: float
    accepted: bool
    guess: bool  # not accepted, but more likely right than nothing
    score: float = 0.0  # motion: standard deviations from chance


@dataclass
class _Evidence:
    equations: list[_Equation] = field(default_factory=list)
    curves: list[Curve] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def accepted(self) -> list[_Equation]:
        return [e for e in self.equations if e.accepted]


def synchronise(
    spans_s: Mapping[str, tuple[float, float]],
    sounds: Mapping[str, Sound],
    motion: Mapping[str, Float[np.ndarray, "_ 2"]],
    method: Method = "auto",
    true_times: bool = False,
    progress: Progress = no_progress,
) -> SyncResult:
    """Put all cameras on the first one's clock.

    Args:
        spans_s: Camera -> (first, last) file time of its frames; the first camera is the reference.
        sounds: Camera -> sound, only for those that have one.
        motion: Camera -> motion energies, rows of (time, energy).
        method: The cue to use; auto: true times where given, else sound, else motion for who has no sound.
        true_times: Whether the frames' times come from a table on one clock.
        progress: Called after each pair.
    Returns:
        Clocks. A camera that no cue reaches keeps its best guess with a confidence below 0.5.
    Raises:
        CalibrationError: If the method asked for cannot be used at all.
    """
    names = list(spans_s)
    if method == "timestamps" and not true_times:
        raise CalibrationError(
            "calibration.sync.method is timestamps, but there is no table; name it in capture.timestamps"
        )
    if true_times and method in ("auto", "timestamps"):
        basis = "the table of times is on one clock"
        return SyncResult({n: Clock(0.0, 0.0, 0.0, "timestamps", 1.0, basis) for n in names})
    if len(names) == 1:
        return SyncResult({names[0]: _reference()})
    if method in ("none", "timestamps"):
        basis = "the clips' own times are taken as true, unchecked"
        clocks = {n: Clock(0.0, 0.0, 0.0, "none", 0.0, basis) for n in names}
        return SyncResult(clocks, notes=("clocks are not synchronised: calibration.sync.method is none",))
    silent = [n for n in names if n not in sounds]
    if method == "audio" and silent:
        raise CalibrationError(
            f"camera {', '.join(silent)}: no sound to synchronise by; set calibration.sync.method to auto or "
            "motion, or give capture.timestamps"
        )
    evidence = _Evidence()
    if method != "motion":
        if silent:
            evidence.notes.append(f"camera {', '.join(silent)}: no sound")
        _hear(names, sounds, evidence, progress)
    if method != "audio" and len(_reached(names, evidence.accepted)) < len(names):
        _watch(names, motion, evidence, progress)
    return _settle(spans_s, evidence)


# --- evidence ---


def _hear(names: Sequence[str], sounds: Mapping[str, Sound], out: _Evidence, progress: Progress) -> None:
    heard = [n for n in names if n in sounds]
    pairs = list(itertools.combinations(heard, 2))
    for i, (a, b) in enumerate(pairs):
        progress(i / len(pairs), f"sound of {a} and {b}")
        found = sound_delay(sounds[a], sounds[b])
        if found is None:
            out.notes.append(f"{a} and {b}: too little sound to compare")
            continue
        c = found.correlation
        out.curves.append(Curve(a, b, "audio", c.delay_s, c.ratio, found.accepted, c.lags_s, c.values))
        if not found.accepted:
            out.notes.append(
                f"{a} and {b}: sound not trusted, its peak is {c.ratio:.1f} times the next one, expected "
                f"{ACCEPT_RATIO:.0f}"
            )
        guess = not found.accepted and c.ratio >= GUESS_RATIO
        out.equations += [
            _Equation(a, b, m.first_s, m.second_s, m.std_s, "audio", c.ratio, found.accepted, guess)
            for m in found.moments
        ]


def _watch(
    names: Sequence[str], motion: Mapping[str, Float[np.ndarray, "_ 2"]], out: _Evidence, progress: Progress
) -> None:
    seen = [n for n in names if n in motion]
    groups = _groups(names, out.accepted)
    pairs = [(a, b) for a, b in itertools.combinations(seen, 2) if groups[a] != groups[b]]
    for i, (a, b) in enumerate(pairs):
        progress(i / len(pairs), f"motion in {a} and {b}")
        found: MotionDelay | None = motion_delay(motion[a], motion[b])
        if found is None:
            out.notes.append(f"{a} and {b}: too little motion to compare")
            continue
        quality = found.correlation * min(1.0, max(0.0, found.margin) / 0.1)
        out.curves.append(
            Curve(a, b, "motion", found.delay_s, quality, found.accepted, found.lags_s, found.values)
        )
        if not found.accepted:
            out.notes.append(
                f"{a} and {b}: motion not trusted (correlation {found.correlation:.2f}, {found.score:.1f} "
                f"standard deviations from chance, {found.margin:.2f} above the next best)"
            )
        guess = not found.accepted and found.score >= GUESS_SCORE and found.margin > 0
        moment = (found.first_s, found.first_s - found.delay_s)
        out.equations.append(
            _Equation(a, b, *moment, found.std_s, "motion", quality, found.accepted, guess, found.score)
        )


# --- solution ---


def _settle(spans_s: Mapping[str, tuple[float, float]], evidence: _Evidence) -> SyncResult:
    """Solve the accepted equations; add the best refused ones for cameras that are not reached otherwise."""
    names, notes = list(spans_s), list(evidence.notes)
    backed = _backed_by_others(spans_s, evidence.equations)
    used, dropped = _consistent(spans_s, [*evidence.accepted, *backed])
    notes += [
        f"{e.a} and {e.b}: {'sound' if e.cue == 'audio' else 'motion'} contradicts the other pairs; dropped"
        for e in dropped
    ]
    notes += [f"{e.a} and {e.b}: motion trusted all the same, other pairs agree with it" for e in backed]
    sure = _reached(names, used)
    guesses = sorted((e for e in evidence.equations if e.guess and e not in backed), key=lambda e: -e.quality)
    for guess in guesses:
        groups = _groups(names, used)
        if groups[guess.a] != groups[guess.b]:
            used.append(guess)
    offset, drift, std, residual = _solve(spans_s, used)
    heard = _reached(names, [e for e in used if e.cue == "audio" and e.accepted])
    reached = _reached(names, used)
    clocks = {names[0]: _reference()}
    for name in names[1:]:
        if name not in reached:
            basis = "no cue that can be trusted; taken as started together with the first camera"
            clocks[name] = Clock(0.0, 0.0, float("inf"), "none", 0.0, basis)
            continue
        cue: Cue = "audio" if name in heard else "motion"
        if name not in sure:
            cue = next(e.cue for e in reversed(used) if name in (e.a, e.b))
        own = [e for e in used if name in (e.a, e.b) and e.cue == cue] or [
            e for e in used if name in (e.a, e.b)
        ]
        quality = max(e.quality for e in own)
        confidence = 1 - 1 / max(quality, 1.0) if cue == "audio" else _motion_confidence(quality)
        if name not in sure:
            confidence = min(confidence, 0.49)
        clocks[name] = Clock(
            float(offset[name]),
            drift[name],
            std[name] if cue == "audio" else max(std[name], min(e.std_s for e in own)),
            cue,
            float(confidence),
            _basis(cue, quality, len(own)),
        )
    if len(heard) < len(names) and heard != {names[0]}:
        rest = [n for n in names if n not in heard]
        notes.append(f"camera {', '.join(rest)}: by motion, the others by sound")
    loop_s = None
    if len(used) > len(reached) - 1:
        loop_s = float(np.abs(residual).max())
    return SyncResult(clocks, tuple(evidence.curves), loop_s, tuple(dict.fromkeys(notes)))


def _solve(
    spans_s: Mapping[str, tuple[float, float]], equations: Sequence[_Equation]
) -> tuple[dict[str, float], dict[str, float], dict[str, float], Float[np.ndarray, " n"]]:
    """Weighted least squares for offsets and drifts; drifts that the data do not show are 0.

    Returns:
        Offset, drift (ppm) and standard deviation in mid-clip of each camera that is reached, and the
        residual of each equation, seconds.
    """
    reached = [name for name in spans_s if name in _reached(list(spans_s), equations)]
    free = reached[1:]
    inside = np.array([e.a in reached for e in equations], dtype=bool)
    equations = [e for e in equations if e.a in reached]
    x, cov, inner = _least_squares(reached, free, equations)
    known = [n for k, n in enumerate(free) if np.sqrt(cov[len(free) + k, len(free) + k]) <= DRIFT_KNOWN_PPM]
    if known != free:
        x, cov, inner = _least_squares(reached, known, equations)
    residual = np.zeros(len(inside))  # of equations between cameras that are not reached: 0
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
    return offset, drift, std, residual


def _least_squares(
    names: Sequence[str], drifting: Sequence[str], equations: Sequence[_Equation]
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


def _consistent(
    spans_s: Mapping[str, tuple[float, float]], equations: list[_Equation]
) -> tuple[list[_Equation], list[_Equation]]:
    """Drop, one by one, the equation that contradicts the others most, as long as all stay connected."""
    names, dropped, kept = list(spans_s), [], list(equations)
    while len(kept) > 1:
        residual = np.abs(_solve(spans_s, kept)[3])
        limit = np.array([max(OUTLIER_SIGMAS * e.std_s, OUTLIER_S[e.cue]) for e in kept])
        worst = int(np.argmax(residual / limit))
        rest = kept[:worst] + kept[worst + 1 :]
        if residual[worst] <= limit[worst] or len(_reached(names, rest)) < len(_reached(names, kept)):
            break
        dropped.append(kept[worst])
        kept = rest
    return kept, dropped


def _backed_by_others(
    spans_s: Mapping[str, tuple[float, float]], equations: Sequence[_Equation]
) -> list[_Equation]:
    """Refused motion equations that the other equations predict within their standard deviation.

    Short clips leave every single pair near chance; several that agree are not. A camera needs two such
    pairs whose distances from chance add up (as for independent tests) to what one pair alone would need.
    """
    names = list(spans_s)
    pool = [e for e in equations if e.accepted or (e.guess and e.quality >= ACCEPT_CORRELATION)]
    predicted = []
    for e in pool:
        rest = [other for other in pool if other is not e]
        if e.cue == "audio" or e.accepted or not {e.a, e.b} <= _reached(names, rest):
            continue
        offset = _solve(spans_s, rest)[0]
        if abs((e.a_s - e.b_s) - (offset[e.b] - offset[e.a])) <= e.std_s:
            predicted.append(e)
    backed: list[_Equation] = []
    for name in names[1:]:
        own = [e for e in predicted if name in (e.a, e.b)]
        if len(own) > 1 and np.sqrt(sum(e.score**2 for e in own)) >= ACCEPT_SCORE:
            backed += [e for e in own if e not in backed]
    return backed


def _groups(names: Sequence[str], equations: Sequence[_Equation]) -> dict[str, int]:
    """Camera -> number of the group it is connected with by accepted equations."""
    group = {name: i for i, name in enumerate(names)}
    for e in equations:
        if group[e.a] != group[e.b]:
            old, new = group[e.b], group[e.a]
            group = {name: new if g == old else g for name, g in group.items()}
    return group


def _reached(names: Sequence[str], equations: Sequence[_Equation]) -> set[str]:
    """Cameras connected with the first one by these equations."""
    group = _groups(names, equations)
    return {name for name in names if group[name] == group[names[0]]}


def _reference() -> Clock:
    return Clock(0.0, 0.0, 0.0, "reference", 1.0, "its clock is the session's")


def _motion_confidence(correlation: float) -> float:
    """0.5 for a correlation that is just accepted, 0.75 for a perfect one: frames are no microphones."""
    return 0.5 + 0.25 * (correlation - ACCEPT_CORRELATION) / (1 - ACCEPT_CORRELATION)


def _basis(cue: Cue, quality: float, pairs: int) -> str:
    count = f"{pairs} comparison{'s' if pairs != 1 else ''}"
    if cue == "audio":
        return (
            f"sound: best peak {quality:.1f} times the next one, {count}; the sound's paths are "
            f"not corrected for ({1e3 * SOUND_PATH_S_PER_M:.1f} ms per metre)"
        )
    return f"motion energy: correlation {quality:.2f}, {count}; good to half a frame at best"
