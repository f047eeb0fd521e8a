"""Every camera's clock from what the cameras heard or saw together.

Every pair of cameras is compared by sound, flashes of light and motion (`sound`, `flash`,
`motion`). Sound and flashes give the clocks, motion those of cameras that neither reaches; all pairs
together are solved by weighted least squares (`equations`), so a pair that contradicts the others shows
and is dropped. Cues that are not needed are compared with the solution: sound that runs late in a camera
agrees with itself everywhere, and only another cue can tell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.cues import (
    ClockEvidence,
    CueComparison,
    Extras,
    LagCurve,
    hear,
    hear_again,
    see_flashes,
    watch,
)
from devrf.calibration.clocks.equations import (
    SURE,
    Clock,
    ClockSolution,
    Cue,
    Equation,
    Loop,
    consistent,
    groups,
    held,
    loops,
    reached_from_first,
    solve,
)
from devrf.calibration.clocks.motion import ACCEPT_CORRELATION, ACCEPT_SCORE
from devrf.calibration.clocks.times import doubts, stated_delay, timecode_guesses
from devrf.capture.system.errors import CalibrationError
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.video.audio import Sound
from devrf.capture.video.recorded import Recorded

Method = Literal["auto", "audio", "motion", "flash", "timestamps", "none"]

SOUND_PATH_S_PER_M = 1 / 343.0
LAG_S, LAG_SIGMAS = 0.01, 3.0  # sound and flash that differ by more contradict; 10 ms are 3 m of air
TIMECODE_CONFIDENCE = 0.75  # where it was asked for: as of sound that needed it
TIMECODE_BASIS = "timecode alone, which is as good as the hand that set it"
MOTION_SIGMAS = 4.0  # motion that differs by more contradicts; views differ, so less says nothing
TRUSTED: tuple[tuple[Cue, tuple[Cue, ...]], ...] = (  # a clock's cue: the first that connects it
    ("audio", ("audio",)),
    ("flash", ("flash",)),
    ("audio", ("audio", "flash")),
)
WORDS = {"audio": "sound", "timestamps": "timecode"}  # cues whose name is not what they are


@dataclass(frozen=True)
class SyncResult:
    """Clocks of all cameras, and what they were taken from.

    Attributes:
        cameras: Name -> clock; the first is the reference.
        curves: One per compared pair and cue.
        loop_s: Largest disagreement of a pair with the solution, seconds; None without spare pairs.
        loops: Closure of every triple of cameras whose pairs were all compared.
        comparisons: Independent cues beside the ones that were used.
        notes: What was decided and why, one sentence each.
    """

    cameras: dict[str, Clock]
    curves: tuple[LagCurve, ...] = ()
    loop_s: float | None = None
    loops: tuple[Loop, ...] = ()
    comparisons: tuple[CueComparison, ...] = ()
    notes: tuple[str, ...] = ()


def synchronise(
    spans_s: Mapping[str, tuple[float, float]],
    sounds: Mapping[str, Sound],
    motion: Mapping[str, Float[np.ndarray, "_ 2"]],
    method: Method = "auto",
    progress: Progress = no_progress,
    extras: Extras | None = None,
) -> SyncResult:
    """Put all cameras on the first one's clock.

    Args:
        spans_s: Camera -> (first, last) file time of its frames; the first camera is the reference.
        sounds: Camera -> sound, only for those that have one.
        motion: Camera -> motion energies, rows of (time, energy).
        method: The cue to use; auto: true times where given, else sound and flashes, else motion.
        progress: Called after each pair.
        extras: What else is known of the clips.
    Returns:
        Clocks. A camera that no cue reaches keeps its best guess with a confidence below 0.5.
    Raises:
        CalibrationError: If the method asked for cannot be used at all.
    """
    extras = extras or Extras()
    names = list(spans_s)
    if extras.true_times and method in ("auto", "timestamps"):
        basis = "the table of times is on one clock"
        return SyncResult({n: Clock(0.0, 0.0, 0.0, "timestamps", 1.0, basis) for n in names})
    if len(names) == 1:
        return SyncResult({names[0]: _reference()})
    longest_s = max(b - a for a, b in spans_s.values())
    if method == "timestamps":
        return _by_timecode(names, extras.recorded, longest_s, extras.known)
    if method == "none":
        basis = "the clips' own times are taken as true, unchecked"
        clocks = {n: Clock(0.0, 0.0, 0.0, "none", 0.0, basis) for n in names}
        return SyncResult(clocks, notes=("clocks are not synchronised: calibration.sync.method is none",))
    known = extras.known
    evidence = ClockEvidence(known=frozenset(known))
    sounds = {n: replace(s, start_s=s.start_s - extras.av_lag_s.get(n, 0.0)) for n, s in sounds.items()}
    if method in ("auto", "audio"):
        silent = [n for n in names if n not in sounds and n not in known]
        if method == "audio" and silent:
            wrong = f"camera {', '.join(silent)}: no sound to synchronise by"
            remedy = "set calibration.sync.method to auto, flash or motion, or give capture.timestamps"
            raise CalibrationError("sound-missing", f"{wrong}; {remedy}")
        if silent:
            evidence.notes.append(f"camera {', '.join(silent)}: no sound")
        hear(names, sounds, evidence, progress)
    if known:
        evidence.equations += held(known, spans_s)
    if method in ("auto", "flash"):
        see_flashes(names, extras, evidence, aloud=method == "flash")
    if method in ("auto", "motion"):
        watch(names, motion, evidence, progress, extras.rest)
    if method in ("auto", "audio"):
        hear_again(names, sounds, extras.recorded, evidence)
    if method == "auto":
        _settle_lags(spans_s, evidence)
        named = {n: extras.recorded[n] for n in names if n in extras.recorded}
        evidence.equations += [e for e in timecode_guesses(named, longest_s) if not {e.a, e.b} <= set(known)]
    result = _settle(spans_s, evidence, known)
    return _against_files(result, extras.recorded, longest_s, known)


def _by_timecode(
    names: Sequence[str], recorded: Mapping[str, Recorded], longest_s: float, known: Mapping[str, Clock]
) -> SyncResult:
    """Clocks by what the files' timecodes say, for cameras that are known to be jammed together."""
    without = [n for n in names if n not in recorded or recorded[n].timecode_s is None]
    if without:
        raise CalibrationError("timestamps-missing", no_timecode(without))
    clocks = {names[0]: _reference()}
    for name in names[1:]:
        stated = stated_delay(recorded[names[0]], recorded[name])
        assert stated is not None
        clocks[name] = Clock(stated[0], 0.0, stated[1], "timestamps", TIMECODE_CONFIDENCE, TIMECODE_BASIS)
    return _against_files(SyncResult(clocks), recorded, longest_s, known)


def no_timecode(cameras: Sequence[str]) -> str:
    """What to say of cameras without a timecode, where the clocks are to come from times."""
    return (
        f"calibration.sync.method is timestamps, but there is no table and the clips of {', '.join(cameras)} have no "
        "timecode; name a table in capture.timestamps, or set the method to auto"
    )


def _settle_lags(spans_s: Mapping[str, tuple[float, float]], evidence: ClockEvidence) -> None:
    """Compare sound with flashes; where they differ, a camera's sound lags, and what its pictures saw counts."""
    sound, flash = (_offsets(spans_s, evidence.accepted(cue)) for cue in ("audio", "flash"))
    first = next(iter(spans_s))
    late = set()
    for name in list(sound.offset_s)[1:]:
        if name not in flash.offset_s or name in evidence.known:
            continue
        difference_s = flash.offset_s[name] - sound.offset_s[name]
        unsure_s = float(np.hypot(sound.std_s[name], flash.std_s[name]))
        limit_s = max(LAG_S, LAG_SIGMAS * unsure_s)
        found = CueComparison(first, name, "audio", "flash", difference_s, limit_s)
        evidence.comparisons.append(found)
        if found.contradicts:
            late.add(name)
            evidence.notes.append(
                f"camera {name}: sound and flash differ by {1e3 * difference_s:+.0f} ms, its sound lags by that "
                f"beside {first}'s; the flash is used; set calibration.sync.av_lag_s: {{{name}: {difference_s:.3f}}}"
            )
    evidence.equations = [
        e for e in evidence.equations if not (e.cue == "audio" and (e.a in late or e.b in late))
    ]


def _offsets(spans_s: Mapping[str, tuple[float, float]], equations: Sequence[Equation]) -> ClockSolution:
    """The clocks by one cue, without what contradicts the rest of it."""
    return solve(spans_s, consistent(spans_s, list(equations))[0])


def _settle(
    spans_s: Mapping[str, tuple[float, float]], evidence: ClockEvidence, known: Mapping[str, Clock]
) -> SyncResult:
    """Solve the accepted equations; add the best refused ones for cameras that are not reached otherwise."""
    names, notes = list(spans_s), list(evidence.notes)
    backed = _backed_by_others(spans_s, evidence.equations)
    used, dropped = consistent(spans_s, [*evidence.accepted(), *backed])
    notes += [f"{e.a} and {e.b}: {_word(e.cue)} contradicts the other pairs; dropped" for e in dropped]
    notes += [f"{e.a} and {e.b}: motion trusted all the same, other pairs agree with it" for e in backed]
    sure = reached_from_first(names, used)
    believed = [loop for loop in loops(names, used) if not set(loop.cameras) <= evidence.known]
    used = _with_guesses(spans_s, used, [e for e in evidence.equations if e.guess and e not in backed])
    solution = solve(spans_s, used)
    reached = reached_from_first(names, used)
    clocks = {names[0]: _reference()} | dict(known)
    new = [name for name in names if name not in clocks]
    for name in new:
        clocks[name] = _clock(name, names, used, solution, reached, name in sure)
    best = {n for n in names if clocks[n].method in ("reference", "audio", "flash")}
    others = [name for name in new if name not in best]
    if others and best != {names[0]}:
        cues = " and ".join(dict.fromkeys(_word(clocks[n].method) for n in names[1:] if n in best))
        notes.append(f"camera {', '.join(others)}: by motion, the others by {cues}")
    loop_s = None
    told = [
        (e, abs(float(r)))
        for r, e in zip(solution.residual_s, used, strict=True)
        if not {e.a, e.b} <= evidence.known
    ]
    if len(told) > len(reached - evidence.known) - (not evidence.known):
        cues = [e.cue for e, _ in told]
        surest = "audio" if "audio" in cues else cues[0]  # others are coarser by far
        loop_s = max(r for e, r in told if e.cue == surest)
    return SyncResult(
        clocks,
        tuple(evidence.curves),
        loop_s,
        tuple(believed),
        (*evidence.comparisons, *_against_motion(solution, evidence.checks)),
        tuple(dict.fromkeys(notes)),
    )


def _with_guesses(
    spans_s: Mapping[str, tuple[float, float]], used: Sequence[Equation], guesses: Sequence[Equation]
) -> list[Equation]:
    """The equations, and guesses for cameras that they leave apart: by sound, then those that most others agree with.

    A view from one side may match at a wrong delay; others then disagree on it, unless the movement is regular.
    """
    used = list(used)
    while True:
        group = groups(list(spans_s), used)
        left = [e for e in guesses if group[e.a] != group[e.b]]
        if not left:
            return used
        offset = _within_groups(spans_s, used, group)
        # By how much the later group of the two is behind the other one.
        late_s = [
            (e.delay_s + offset[e.a] - offset[e.b]) * (1 if group[e.a] < group[e.b] else -1) for e in left
        ]
        between = [{group[e.a], group[e.b]} for e in left]
        speaks = [
            sum(
                other.score**2
                for other, its_late_s, its_between in zip(left, late_s, between, strict=True)
                if its_between == mine and abs(its_late_s - s) <= np.hypot(e.std_s, other.std_s)
            )
            for e, s, mine in zip(left, late_s, between, strict=True)
        ]
        best = max(range(len(left)), key=lambda n: (left[n].cue == "audio", speaks[n], left[n].quality))
        used.append(left[best])


def _within_groups(
    spans_s: Mapping[str, tuple[float, float]], used: Sequence[Equation], group: Mapping[str, int]
) -> dict[str, float]:
    """Offset of each camera from the first one of its group."""
    offset: dict[str, float] = {}
    for name, span in spans_s.items():
        if name not in offset:
            mine = {name: span} | {n: s for n, s in spans_s.items() if group[n] == group[name]}
            offset |= solve(mine, [e for e in used if e.a in mine and e.b in mine]).offset_s
    return offset


def _clock(
    name: str,
    names: Sequence[str],
    used: Sequence[Equation],
    solution: ClockSolution,
    reached: set[str],
    sure: bool,
) -> Clock:
    """A camera's clock, its cue (the best one that connects it with the first camera) and its confidence."""
    if name not in reached:
        basis = "no cue that can be trusted; taken as started together with the first camera"
        return Clock(0.0, 0.0, float("inf"), "none", 0.0, basis)
    cue: Cue = "motion"
    for best, those in TRUSTED:
        if name in reached_from_first(names, [e for e in used if e.accepted and e.cue in those]):
            cue = best
            break
    if not sure:
        cue = next(e.cue for e in reversed(used) if name in (e.a, e.b))
    mine = [e for e in used if name in (e.a, e.b)]
    own = [e for e in mine if e.cue == cue] or mine
    quality = max(e.quality for e in own)
    confidence = {
        "audio": 1 - 1 / max(quality, 1.0),
        "flash": 1 - 1 / (1 + quality),
        "motion": _motion_confidence(quality),
        "timestamps": 0.0,
    }[cue]
    if not sure:
        confidence = min(confidence, 0.49)
    std_s = solution.std_s[name]
    if cue == "motion":
        std_s = max(std_s, min(e.std_s for e in own))
    return Clock(
        solution.offset_s[name],
        solution.drift_ppm[name],
        std_s,
        cue,
        float(confidence),
        _basis(cue, quality, len(own)),
    )


def _against_motion(solution: ClockSolution, checks: Sequence[Equation]) -> list[CueComparison]:
    """Motion that was not needed, against the clocks by sound and flashes."""
    out = []
    for e in checks:
        if e.accepted and e.a in solution.offset_s and e.b in solution.offset_s:
            a, b = (Clock(solution.offset_s[n], solution.drift_ppm[n]) for n in (e.a, e.b))
            difference_s = a.true_time(e.a_s) - b.true_time(e.b_s)
            out.append(CueComparison(e.a, e.b, "audio", "motion", difference_s, MOTION_SIGMAS * e.std_s))
    return out


def _against_files(
    result: SyncResult,
    recorded: Mapping[str, Recorded],
    longest_s: float,
    known: Mapping[str, Clock],
) -> SyncResult:
    """The result, with a note for each file, but those of `known` clocks, whose own times contradict it."""
    first = next(iter(result.cameras))
    measured = {
        (first, n): c.offset_s for n, c in result.cameras.items() if n != first and c.confidence >= SURE
    }
    new = [n for n in result.cameras if n == first or n not in known]
    named = {n: recorded[n] for n in new if n in recorded}
    if first not in named:
        return result
    return replace(result, notes=(*result.notes, *doubts(named, measured, longest_s)))


def _backed_by_others(
    spans_s: Mapping[str, tuple[float, float]], equations: Sequence[Equation]
) -> list[Equation]:
    """Refused motion equations that the other equations predict within their standard deviation.

    Short clips leave every single pair near chance; several that agree are not. A camera needs two such
    pairs whose distances from chance add up (as for independent tests) to what one pair alone would need.
    """
    names = list(spans_s)
    pool = [e for e in equations if e.accepted or (e.guess and e.quality >= ACCEPT_CORRELATION)]
    predicted = []
    for e in pool:
        rest = [other for other in pool if other is not e]
        if e.cue != "motion" or e.accepted or not {e.a, e.b} <= reached_from_first(names, rest):
            continue
        offset = solve(spans_s, rest).offset_s
        if abs(e.delay_s - (offset[e.b] - offset[e.a])) <= e.std_s:
            predicted.append(e)
    backed: list[Equation] = []
    for name in names[1:]:
        own = [e for e in predicted if name in (e.a, e.b)]
        if len(own) > 1 and np.sqrt(sum(e.score**2 for e in own)) >= ACCEPT_SCORE:
            backed += [e for e in own if e not in backed]
    return backed


def _reference() -> Clock:
    return Clock(0.0, 0.0, 0.0, "reference", 1.0, "its clock is the session's")


def _motion_confidence(correlation: float) -> float:
    """0.5 for a correlation that is just accepted, 0.75 for a perfect one: frames are no microphones."""
    return 0.5 + 0.25 * (correlation - ACCEPT_CORRELATION) / (1 - ACCEPT_CORRELATION)


def _word(cue: str) -> str:
    return WORDS.get(cue, cue)


def _basis(cue: Cue, quality: float, pairs: int) -> str:
    count = f"{pairs} comparison{'s' if pairs != 1 else ''}"
    if cue == "audio":
        return (
            f"sound: best peak {quality:.1f} times the next one, {count}; the sound's paths are "
            f"not corrected for ({1e3 * SOUND_PATH_S_PER_M:.1f} ms per metre)"
        )
    if cue == "flash":
        return f"light: {quality:.0f} flash{'es' if quality > 1 else ''} seen in common, {count}"
    if cue == "timestamps":
        return TIMECODE_BASIS
    return f"motion energy: correlation {quality:.2f}, {count}; good to half a frame at best"
