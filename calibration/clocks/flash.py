"""The delay between two clips by flashes of light that both saw, to a fraction of a frame.

A rolling shutter reads its rows one after the other, so the brightness of rows over (frame time + row share
x readout) is a series that is finer than the frames: a flash or a lamp switched on shows the row at which
the picture changes (Šmíd & Matas, "Rolling shutter camera synchronization with sub-millisecond accuracy",
VISAPP 2017). Readout times are seldom known. They get a prior, and several flashes, which hit the frames at
different rows, determine them together with the delay.

A delay here is `file time in the first clip - file time in the second` of one and the same flash.
"""

import itertools
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from devrf.calibration.clocks.spans import inside

SEEN_SIGMAS = 5.0  # a jump of the brightness between frames this many standard deviations high is an event
LEAST_LEVELS = 1.5  # and at least this high, in levels of 255: an encoder's key frames jump by half a level
SLOW_FRAMES = 15  # changes over more frames than this are exposure and daylight
EVENT_FRAMES = 3  # a flash is over after this many
LIT_ROWS = 0.25  # of the largest change: rows that change less do not see the light
STEP_SHARE = 0.5  # what remains afterwards, of the change: more is a lamp switched on or off
READOUT_SHARE, READOUT_STD = 0.7, 0.15  # of a frame: prior, phones and action cameras
KNOWN_READOUT_STD = 0.02  # of a given readout
PERIODIC_EVENTS, PERIODIC_SPREAD = 4, 0.08  # this many at equal distances: a lamp that blinks, no code
SAME_FRAMES = 1.0  # two flashes farther apart than this under a trial delay are not the same
SLOPE_STEP = 0.02  # relative change of the readout by which the effect on an event's time is measured
STD_FLOOR_S = 3e-4  # a flash lasts a millisecond


@dataclass(frozen=True)
class Brightness:
    """Mean brightness of bands of rows (in the order the sensor reads them) [n, r] at frame times [n]."""

    time_s: Float[np.ndarray, " n"]
    rows: Float[np.ndarray, "n r"]


@dataclass(frozen=True)
class Flash:
    """One event in one clip: it happened at `frame_s + row * readout`, whatever the readout is.

    Attributes:
        frame_s: Time of the frame in which it shows; between two where it shows in both.
        row: Share of the height at which it shows, the mean over what is lit.
        spread_s: Standard deviation from the gap between the rows or frames it lies between.
        kind: Lamp switched (step) or flash (pulse).
        sign: Brighter (1) or darker (-1).
    """

    frame_s: float
    row: float
    spread_s: float
    kind: Literal["step", "pulse"]
    sign: int


@dataclass(frozen=True)
class Flashes:
    """All events in one clip, its frame step, its readout (None: unknown) and what is wrong with the events."""

    events: tuple[Flash, ...]
    step_s: float
    readout_s: float | None
    largest_sigmas: float
    periodic: bool

    @property
    def readout(self) -> tuple[float, float]:
        """Readout and its standard deviation, seconds, before anything is compared."""
        if self.readout_s is not None:
            return self.readout_s, KNOWN_READOUT_STD * self.readout_s
        return READOUT_SHARE * self.step_s, READOUT_STD * self.step_s

    def time_s(self, flash: Flash) -> float:
        """File time of an event by the readout's prior."""
        return flash.frame_s + flash.row * self.readout[0]


@dataclass(frozen=True)
class FlashDelay:
    """How two clips lie to each other by their flashes.

    Attributes:
        delay_s: File time in the first clip minus file time in the second.
        std_s: Its standard deviation.
        first_s: File time in the first clip in the middle of the flashes.
        matches: Number of flashes that both saw.
        accepted: Whether no other delay explains as many.
        lone_step: Whether all there is to it is light that changed once, in each clip, and stayed so.
    """

    delay_s: float
    std_s: float
    first_s: float
    matches: int
    accepted: bool
    lone_step: bool = False


def find_flashes(brightness: Brightness, readout_s: float | None = None) -> Flashes:
    """Sudden changes of the light in one clip, but for those at the edges of its file."""
    step_s = float(np.median(np.diff(brightness.time_s)))
    assumed_s = READOUT_SHARE * step_s if readout_s is None else readout_s
    mean = brightness.rows.mean(axis=1)
    jump = np.diff(mean)
    jump = jump - median_filter(jump, min(SLOW_FRAMES, len(jump)), mode="nearest")
    sigma = max(1.4826 * float(np.median(np.abs(jump))), LEAST_LEVELS / SEEN_SIGMAS)
    time_s = brightness.time_s
    jump[~inside((time_s[1:] + time_s[:-1]) / 2, (time_s[0], time_s[-1]))] = 0.0
    loud = np.flatnonzero(np.abs(jump) > SEEN_SIGMAS * sigma)
    found = [_event(brightness, int(group[0]), int(group[-1]) + 1, assumed_s) for group in _grouped(loud)]
    events = [event for event in found if event is not None]
    times = np.array([e.frame_s + e.row * assumed_s for e in events])
    gaps = np.diff(times)
    periodic = len(events) >= PERIODIC_EVENTS and float(gaps.std()) < PERIODIC_SPREAD * float(gaps.mean())
    largest = float(np.abs(jump).max() / sigma) if len(jump) else 0.0
    return Flashes(tuple(events), step_s, readout_s, largest, periodic)


def flash_delay(first: Flashes, second: Flashes) -> FlashDelay | None:
    """Delay between two clips; None where they saw no flash of the same kind."""
    slack_s = SAME_FRAMES * max(first.step_s, second.step_s)
    trials = [
        first.time_s(a) - second.time_s(b)
        for a, b in itertools.product(first.events, second.events)
        if _alike(a, b)
    ]
    if not trials:
        return None
    matched = [_matched(first, second, delay_s, slack_s) for delay_s in trials]
    spread = [np.std([first.time_s(a) - second.time_s(b) for a, b in pairs]) for pairs in matched]
    best = min(range(len(trials)), key=lambda i: (-len(matched[i]), spread[i]))
    rival = max(
        (len(m) for m, t in zip(matched, trials, strict=True) if abs(t - trials[best]) > 2 * slack_s),
        default=0,
    )
    pairs = matched[best]
    delay_s, std_s = _fit(first, second, pairs)
    first_s = float(np.mean([first.time_s(a) for a, _ in pairs]))
    alone = len(first.events) == len(second.events) == 1
    accepted = (len(pairs) > max(rival, 1) or alone) and not (first.periodic or second.periodic)
    lone_step = alone and pairs[0][0].kind == "step"
    return FlashDelay(delay_s, std_s, first_s, len(pairs), accepted, lone_step)


def _event(brightness: Brightness, before: int, after: int, readout_s: float) -> Flash | None:
    """One event between frame `before`, not yet changed, and frame `after`, changed for good or over."""
    time_s, rows = brightness.time_s, brightness.rows
    dark = np.median(rows[max(0, before - EVENT_FRAMES + 1) : before + 1], axis=0)
    late = np.median(rows[after : after + EVENT_FRAMES], axis=0)
    change = rows[before : after + 1] - dark
    largest = change[int(np.argmax(np.abs(change.mean(axis=1))))]
    step = bool(abs((late - dark).mean()) > STEP_SHARE * abs(largest.mean()))
    goal = late - dark if step else _extreme(change)
    seen = np.abs(goal) > LIT_ROWS * np.abs(goal).max()
    sign = int(np.sign(goal[seen].mean()))
    share = ((np.arange(rows.shape[1]) + 0.5) / rows.shape[1])[seen]
    lit = np.clip((change[:, seen] / goal[seen]).ravel(), 0, 1)
    middle = _middle_of_step if step else _middle_of_pulse
    at: list[float] = []
    gap_s = 0.0
    for trial_s in (readout_s, (1 + SLOPE_STEP) * readout_s):
        where = middle((time_s[before : after + 1, None] + share * trial_s).ravel(), lit)
        if where is None:
            return None
        at.append(where[0])
        gap_s = gap_s or where[1]
    row = (at[1] - at[0]) / (SLOPE_STEP * readout_s)
    kind = "step" if step else "pulse"
    return Flash(at[0] - row * readout_s, row, float(gap_s / np.sqrt(12)), kind, sign)


def _extreme(change: Float[np.ndarray, "k r"]) -> Float[np.ndarray, " r"]:
    """Of each row, its change of largest size, in the sense in which most change."""
    sign = np.sign(change.sum())
    return sign * np.maximum((sign * change).max(axis=0), 0)


def _middle_of_step(
    axis: Float[np.ndarray, " n"], lit: Float[np.ndarray, " n"]
) -> tuple[float, float] | None:
    """Where a series that rises from 0 to 1 does so, and the gap it lies in: the area above it, in row time."""
    above = 1 - lit
    at = float(axis[0] + np.sum((above[1:] + above[:-1]) / 2 * np.diff(axis)))
    return (at, _gap(axis, at)) if above[0] > 0.5 else None


def _middle_of_pulse(
    axis: Float[np.ndarray, " n"], lit: Float[np.ndarray, " n"]
) -> tuple[float, float] | None:
    """Centre of a series that rises from 0 and falls to 0 again, and the gap of its edges."""
    lit = np.where(lit > 0.1, lit, 0.0)
    width = np.gradient(axis)
    total = float((lit * width).sum())
    if total <= 0:
        return None
    at = float((lit * width * axis).sum() / total)
    edges = axis[lit > 0.5]
    if not len(edges):
        return None
    return at, float(np.hypot(_gap(axis, edges[0] - 1e-9), _gap(axis, edges[-1] + 1e-9))) / 2


def _gap(axis: Float[np.ndarray, " n"], at: float) -> float:
    k = int(np.clip(np.searchsorted(axis, at), 1, len(axis) - 1))
    return float(axis[k] - axis[k - 1])


def _grouped(places: np.ndarray) -> list[np.ndarray]:
    """Runs of places no farther apart than a flash lasts."""
    if not len(places):
        return []
    return np.split(places, np.flatnonzero(np.diff(places) > EVENT_FRAMES) + 1)


def _alike(a: Flash, b: Flash) -> bool:
    return a.kind == b.kind and a.sign == b.sign


def _matched(first: Flashes, second: Flashes, delay_s: float, slack_s: float) -> list[tuple[Flash, Flash]]:
    """Events of both clips that are the same under a trial delay, each used once."""
    pairs, free = [], list(second.events)
    for a in first.events:
        near = [
            b for b in free if _alike(a, b) and abs(first.time_s(a) - second.time_s(b) - delay_s) <= slack_s
        ]
        if near:
            b = min(near, key=lambda b: abs(first.time_s(a) - second.time_s(b) - delay_s))
            free.remove(b)
            pairs.append((a, b))
    return pairs


def _fit(first: Flashes, second: Flashes, pairs: list[tuple[Flash, Flash]]) -> tuple[float, float]:
    """Delay and its standard deviation: least squares over the matches, both readouts unknown with priors."""
    A = np.array([[1.0, -a.row, b.row] for a, b in pairs])
    y = np.array([a.frame_s - b.frame_s for a, b in pairs])
    sigma = np.array([np.hypot(np.hypot(a.spread_s, b.spread_s), STD_FLOOR_S) for a, b in pairs])
    priors = np.array([first.readout, second.readout])
    prior_rows = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) / priors[:, 1:]
    weighted = np.concatenate([A / sigma[:, None], prior_rows])
    target = np.concatenate([y / sigma, priors[:, 0] / priors[:, 1]])
    x, *_ = np.linalg.lstsq(weighted, target, rcond=None)
    spare = len(pairs) - 1
    misfit = float(np.sum(((y - A @ x) / sigma) ** 2))
    scatter = max(1.0, np.sqrt(misfit / spare)) if spare else 1.0
    return float(x[0]), float(scatter * np.sqrt(np.linalg.inv(weighted.T @ weighted)[0, 0]))
