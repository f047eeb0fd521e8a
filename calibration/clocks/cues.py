"""What the cameras heard and saw together: equations between two clocks, by sound, flashes of light and motion."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.equations import Clock, Equation, PairCue, groups
from devrf.calibration.clocks.flash import Brightness, Flashes, find_flashes, flash_delay
from devrf.calibration.clocks.motion import MotionDelay, motion_delay
from devrf.calibration.clocks.sound import ACCEPT_RATIO, SoundDelay, sound_delay
from devrf.calibration.clocks.spans import EDGE_S
from devrf.calibration.clocks.times import stated_delay
from devrf.capture.rest import Rest
from devrf.capture.system.progress import Progress
from devrf.capture.video.audio import Sound
from devrf.capture.video.recorded import Recorded

GUESS_RATIO = 1.5  # a refused cue this good is still taken as a guess, with a confidence below one half
GUESS_SCORE = 2.0
PRIOR_STD_S = 0.1  # a delay known this well beforehand can settle which of several peaks of sound is right
PRIOR_SIGMAS = 3.0
PRIOR_CONFIDENCE = 0.75  # of sound that needed it
AT_EDGES = f"without the first and last {EDGE_S} s of the clips it is another"


@dataclass(frozen=True)
class LagCurve:
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
class CueComparison:
    """Two independent cues for the delay between two cameras.

    Attributes:
        first, second: Cameras.
        cue, other: What is compared with what.
        difference_s: Delay by `other` minus delay by `cue`.
        limit_s: Beyond it they contradict each other.
    """

    first: str
    second: str
    cue: PairCue
    other: PairCue
    difference_s: float
    limit_s: float

    @property
    def contradicts(self) -> bool:
        """Whether the cues cannot both be right."""
        return abs(self.difference_s) > self.limit_s


@dataclass(frozen=True)
class Extras:
    """What else is known of the clips; every part may be missing.

    Attributes:
        brightness: Camera -> brightness of rows over time, for flashes.
        recorded: Camera -> what its file says of its beginning.
        av_lag_s: Camera -> how late its sound is behind its pictures.
        readout_s: Camera -> time from the first row's reading to the last one's.
        rest: When the clips show the scene at rest.
        true_times: Whether the frames' times come from a table on one clock.
        known: Clocks that stand, the first camera's among them; the others are found against these.
    """

    brightness: Mapping[str, Brightness] = field(default_factory=dict)
    recorded: Mapping[str, Recorded] = field(default_factory=dict)
    av_lag_s: Mapping[str, float] = field(default_factory=dict)
    readout_s: Mapping[str, float] = field(default_factory=dict)
    rest: Rest = "none"
    true_times: bool = False
    known: Mapping[str, Clock] = field(default_factory=dict)


@dataclass
class ClockEvidence:
    """What was heard and seen: equations for the clocks, and what is to be told about them.

    Two cameras of which both are `known` are not compared: their clocks stand.
    """

    known: frozenset[str] = frozenset()
    equations: list[Equation] = field(default_factory=list)
    checks: list[Equation] = field(default_factory=list)  # not needed for the clocks
    comparisons: list[CueComparison] = field(default_factory=list)
    curves: list[LagCurve] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def accepted(self, *cues: PairCue) -> list[Equation]:
        """Believed equations of these cues; of all without any."""
        return [e for e in self.equations if e.accepted and (not cues or e.cue in cues)]

    def pairs(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """The cameras that are compared with each other."""
        return [(a, b) for a, b in itertools.combinations(names, 2) if not {a, b} <= self.known]


def hear(names: Sequence[str], sounds: Mapping[str, Sound], out: ClockEvidence, progress: Progress) -> None:
    """Compare the sound of every pair."""
    heard = [n for n in names if n in sounds]
    pairs = out.pairs(heard)
    for i, (a, b) in enumerate(pairs):
        progress(i / len(pairs), f"sound of {a} and {b}")
        found = sound_delay(sounds[a], sounds[b])
        if found is None:
            out.notes.append(f"{a} and {b}: too little sound to compare")
            continue
        c = found.correlation
        out.curves.append(LagCurve(a, b, "audio", c.delay_s, c.ratio, found.accepted, c.lags_s, c.values))
        if not found.accepted:
            why = "" if c.beat_s is None else f" (beat every {c.beat_s:.2f} s: ambiguous)"
            out.notes.append(
                f"{a} and {b}: sound not trusted, its peak is {c.ratio:.1f} times the next one, expected "
                f"{ACCEPT_RATIO:.0f}{why}"
            )
        out.equations += _sound_equations(a, b, found, found.accepted)


def _sound_equations(a: str, b: str, found: SoundDelay, accepted: bool) -> list[Equation]:
    ratio = found.correlation.ratio
    guess = not accepted and ratio >= GUESS_RATIO
    return [
        Equation(a, b, m.first_s, m.second_s, m.std_s, "audio", ratio, accepted, guess) for m in found.moments
    ]


def hear_again(
    names: Sequence[str], sounds: Mapping[str, Sound], recorded: Mapping[str, Recorded], out: ClockEvidence
) -> None:
    """Sound with several peaks, near the delay that another cue or a timecode states: which peak is right."""
    trusted = {(e.a, e.b) for e in out.accepted("audio")}
    for a, b in out.pairs(n for n in names if n in sounds):
        prior = _prior(a, b, recorded, out)
        if (a, b) in trusted or prior is None:
            continue
        around_s, std_s, what = prior
        found = sound_delay(sounds[a], sounds[b], around_s, PRIOR_SIGMAS * std_s)
        if found is not None and found.accepted:
            out.equations = [e for e in out.equations if not (e.cue == "audio" and (e.a, e.b) == (a, b))]
            quality = min(found.correlation.ratio, 1 / (1 - PRIOR_CONFIDENCE))
            out.equations += [replace(e, quality=quality) for e in _sound_equations(a, b, found, True)]
            out.notes.append(f"{a} and {b}: sound trusted all the same, near the delay by {what}")


def _prior(
    a: str, b: str, recorded: Mapping[str, Recorded], out: ClockEvidence
) -> tuple[float, float, str] | None:
    """A delay known well enough to choose between peaks of sound, its standard deviation, and whose it is."""
    priors = [(e.delay_s, e.std_s, e.cue) for e in out.accepted("flash", "motion") if (e.a, e.b) == (a, b)]
    if a in recorded and b in recorded and (stated := stated_delay(recorded[a], recorded[b])):
        priors.append(stated)
    return min((p for p in priors if p[1] <= PRIOR_STD_S), key=lambda p: p[1], default=None)


def see_flashes(names: Sequence[str], extras: Extras, out: ClockEvidence, aloud: bool) -> None:
    """Compare flashes; what was not seen is said where flashes were asked for or others saw some."""
    seen: dict[str, Flashes] = {
        n: find_flashes(extras.brightness[n], extras.readout_s.get(n))
        for n in names
        if n in extras.brightness
    }
    if not aloud and sum(len(f.events) > 0 for f in seen.values()) < 2:
        return
    for name, found in seen.items():
        if name in out.known:
            continue
        if found.periodic:
            out.notes.append(f"camera {name}: flashes come at equal distances (periodic), not used")
        elif not found.events:
            out.notes.append(
                f"camera {name}: saw no flash (largest step {found.largest_sigmas:.1f} standard deviations)"
            )
        else:
            rows = ", ".join(f"{e.frame_s:.2f} s row {100 * min(e.row, 1):.0f} %" for e in found.events[:4])
            out.notes.append(f"camera {name}: {len(found.events)} flashes ({rows} of the height)")
    by_sound = groups(names, out.accepted("audio"))
    for a, b in out.pairs(seen):
        found = flash_delay(seen[a], seen[b])
        if found is None:
            continue
        if found.lone_step and by_sound[a] == by_sound[b]:
            out.notes.append(
                f"{a} and {b}: the light changes once and stays so, which is no flash; sound counts"
            )
            continue
        if not found.accepted:
            out.notes.append(f"{a} and {b}: flashes not trusted, several delays explain as many")
        out.equations.append(
            Equation(
                a,
                b,
                found.first_s,
                found.first_s - found.delay_s,
                found.std_s,
                "flash",
                float(found.matches),
                found.accepted,
                not found.accepted and not (seen[a].periodic or seen[b].periodic),
            )
        )


def watch(
    names: Sequence[str],
    motion: Mapping[str, Float[np.ndarray, "_ 2"]],
    out: ClockEvidence,
    progress: Progress,
    rest: Rest = "none",
) -> None:
    """Compare motion: for the clocks where sound and flashes do not connect two cameras, else as a check.

    `rest`: when the clips show the scene at rest.
    """
    seen = [n for n in names if n in motion]
    group = groups(names, out.accepted())
    pairs = out.pairs(seen)
    for i, (a, b) in enumerate(pairs):
        needed = group[a] != group[b]
        progress(i / len(pairs), f"motion in {a} and {b}")
        found: MotionDelay | None = motion_delay(motion[a], motion[b], rest)
        if found is None:
            if needed:
                out.notes.append(f"{a} and {b}: too little motion to compare")
            continue
        quality = found.correlation * min(1.0, max(0.0, found.margin) / 0.1)
        guess = not found.accepted and found.lasts and found.score >= GUESS_SCORE and found.margin > 0
        moment = (found.first_s, found.first_s - found.delay_s)
        equation = Equation(a, b, *moment, found.std_s, "motion", quality, found.accepted, guess, found.score)
        if not needed:
            out.checks.append(equation)
            continue
        out.equations.append(equation)
        out.curves.append(
            LagCurve(a, b, "motion", found.delay_s, quality, found.accepted, found.lags_s, found.values)
        )
        if not found.lasts:
            out.notes.append(f"{a} and {b}: motion not trusted, {AT_EDGES}")
        elif not found.accepted:
            out.notes.append(
                f"{a} and {b}: motion not trusted (correlation {found.correlation:.2f}, {found.score:.1f} "
                f"standard deviations from chance, {found.margin:.2f} above the next best)"
            )
