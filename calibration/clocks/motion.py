"""The delay between two silent clips, by how much moves in each at each time.

Motion energy is the mean absolute difference of successive frames, at the time midway between them. Views
from different sides see different amounts of the same movement, so only its course counts: the square
root flattens the peaks, and the correlation is normalised over what overlaps at each lag. Half a frame is the
best accuracy to be claimed; where views differ and the peak is wide, the standard deviation is larger.

Where clips begin with the scene at rest nothing moves before that either (where they end with it, after it). So the
courses go on beyond the clips, and a delay at which one shows motion then is refuted; without, half of a regular
movement may match the wrong half.

A delay here is `file time in the first clip - file time in the second` of one and the same movement.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.signal import find_peaks

from devrf.calibration.clocks.sound import fast_size, top_of_parabola
from devrf.calibration.clocks.spans import inside
from devrf.capture.rest import Rest

OVERSAMPLING = 4  # grid points per frame step
MIN_OVERLAP_SHARE = 0.5  # of the shorter clip: less would let two single gestures match by chance
MIN_OVERLAP_STEPS = 12
OUTLIER_QUANTILE = 0.99  # one flash or cut must not be all there is
DISTINCT_STEPS = 2.0  # another peak closer than this many frames is the same one
END_PICTURES, END_TIMES = 8, 3.0  # within so many pictures of an end, more than so many times all else
MIN_VARIATION = 0.05  # standard deviation over mean of the energy: below it nothing happens
ACCEPT_CORRELATION = 0.6  # below it views disagree
ACCEPT_SCORE = 4.0  # standard deviations away from chance (Fisher's z with independent samples)
GUESSED = 3.9  # of that, at most, where only rest beyond the clips tells which peak is right
ACCEPT_MARGIN = 0.1  # peak minus next best; periodic movement has equals one period away
CURVE_S = 0.5
REST_STEPS = 4  # pictures at the end of a clip
LASTING_SIGMAS = 2.0  # by which an estimate may move when the files' edges are left out
AT_REST = 0.25  # of the range of the energy's root: below it nothing moves


@dataclass(frozen=True)
class MotionDelay:
    """How two clips lie to each other by their motion.

    Attributes:
        delay_s: File time in the first clip minus file time in the second.
        first_s: File time in the first clip in the middle of what both show.
        std_s: Standard deviation of the delay, at least half a frame.
        correlation: Normalised correlation at the peak, -1 to 1.
        score: How many standard deviations that is away from chance.
        margin: How much more evidence (correlation times root of the overlap) it has than any rival.
        lags_s, values: The curve around the peak [n].
        lasts: Whether it is found without the edges of the files, too.
    """

    delay_s: float
    first_s: float
    std_s: float
    correlation: float
    score: float
    margin: float
    lags_s: Float[np.ndarray, " n"]
    values: Float[np.ndarray, " n"]
    lasts: bool = True

    @property
    def accepted(self) -> bool:
        """Whether the peak is high and alone enough to be believed, and does not come from the files' edges."""
        return (
            self.lasts
            and self.correlation >= ACCEPT_CORRELATION
            and self.score >= ACCEPT_SCORE
            and self.margin >= ACCEPT_MARGIN
        )


def motion_delay(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "m 2"], rest: Rest = "none"
) -> MotionDelay | None:
    """Delay between two clips by their motion energies.

    Args:
        first, second: Rows of (time, energy).
        rest: When the clips show the scene at rest; at the start or end it rested beyond, too.
    Returns:
        None where a clip is too short, or nothing moves in it.
    """
    found = _delay(first, second, rest)
    if found is None:
        return None
    inner = _delay(_inside(first), _inside(second), rest)
    if inner is None:
        return replace(found, lasts=False)
    limit_s = LASTING_SIGMAS * np.hypot(found.std_s, inner.std_s)
    return replace(found, lasts=bool(abs(inner.delay_s - found.delay_s) <= limit_s))


def _inside(course: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    return course[inside(course[:, 0], (course[0, 0], course[-1, 0]))]


def _delay(
    first: Float[np.ndarray, "n 2"], second: Float[np.ndarray, "m 2"], rest: Rest
) -> MotionDelay | None:
    if min(len(first), len(second)) < MIN_OVERLAP_STEPS:
        return None
    a, b = (_root(m[:, 1]) for m in (first, second))
    if a is None or b is None:
        return None
    a_s, b_s = first[:, 0], second[:, 0]
    plain = course_delay(a_s, a[:, None], b_s, b[:, None])
    if rest not in ("start", "end"):
        return plain
    (a_s, a), (b_s, b) = _beyond(a_s, a, rest), _beyond(b_s, b, rest)
    longer = course_delay(a_s, a[:, None], b_s, b[:, None])
    # At rest all lags nearly agree: that tells which peak is right, but less of where it is, and is no second proof.
    if longer is None or (
        plain is not None and abs(plain.delay_s - longer.delay_s) <= np.hypot(plain.std_s, longer.std_s)
    ):
        return plain
    return replace(longer, score=min(longer.score, GUESSED))


def _beyond(
    time_s: Float[np.ndarray, " n"], root: Float[np.ndarray, " n"], rest: Literal["start", "end"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """The course with as much rest before or after it as it is long, if it rests at that end."""
    if rest == "end":
        time_s, root = _beyond(-time_s[::-1], root[::-1], "start")
        return -time_s[::-1], root[::-1]
    lowest, highest = np.quantile(root, [0.05, 0.9])
    level = float(np.median(root[:REST_STEPS]))
    if level > lowest + AT_REST * (highest - lowest):
        return time_s, root
    step = float(np.median(np.diff(time_s)))
    before = time_s[0] - step * np.arange(len(root), 0, -1)
    return np.concatenate([before, time_s]), np.concatenate([np.full(len(root), level), root])


def course_delay(
    first_s: Float[np.ndarray, " n"],
    first: Float[np.ndarray, "n channels"],
    second_s: Float[np.ndarray, " m"],
    second: Float[np.ndarray, "m channels"],
) -> MotionDelay | None:
    """Delay between two courses of one or more channels that have the same meaning in both clips.

    Args:
        first_s, second_s: File times, ascending.
        first, second: Values at these times.
    Returns:
        None where the clips are too short to overlap enough, or no delay stands out at all.
    """
    steps = [float(np.median(np.diff(t))) for t in (first_s, second_s)]
    dt = min(steps) / OVERSAMPLING
    a, b = _on_grid(first_s, first, dt), _on_grid(second_s, second, dt)
    minimum = max(MIN_OVERLAP_SHARE * min(len(a), len(b)), MIN_OVERLAP_STEPS * OVERSAMPLING)
    lags, values, share = _normalised_correlation(a, b, int(minimum))
    tops = find_peaks(values)[0] if len(lags) else []
    if not len(tops):
        return None
    evidence = values * np.sqrt(share)  # few samples correlate highly by chance
    peak = int(max(tops, key=lambda i: evidence[i]))
    apart = np.abs(lags - lags[peak]) * dt > DISTINCT_STEPS * max(steps)
    rivals = [evidence[i] for i in tops if apart[i]]
    rivals += [evidence[i] for i in (0, len(lags) - 1) if apart[i]]  # it may still rise beyond the ends
    margin = float(evidence[peak] - max(rivals, default=0.0))
    shift_s = first_s[0] - second_s[0]
    reach = OVERSAMPLING  # one frame step: the grid's own spacing is interpolated, and bends nothing
    delay_s = (lags[peak] + top_of_parabola(values, peak, reach, most=1.0)) * dt + shift_s
    lags_s = lags * dt + shift_s
    near = np.abs(lags_s - delay_s) <= max(CURVE_S, 15 * max(steps))
    from_s, to_s = max(first_s[0], second_s[0] + delay_s), min(first_s[-1], second_s[-1] + delay_s)
    spread_s, score = _spread(lags_s, values, peak, to_s - from_s)
    return MotionDelay(
        delay_s=float(delay_s),
        first_s=float((from_s + to_s) / 2),
        std_s=max(max(steps) / 2, spread_s),
        correlation=float(values[peak]),
        score=score,
        margin=margin,
        lags_s=lags_s[near],
        values=values[near],
    )


def _root(energy: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"] | None:
    """Square root of the energy without its outliers; None where it hardly varies."""
    energy = np.minimum(_without_ends(energy), np.quantile(energy, OUTLIER_QUANTILE))
    root = np.sqrt(np.maximum(energy, 0))
    return root if root.std() >= MIN_VARIATION * max(float(root.mean()), 1e-6) else None


def _without_ends(energy: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """The energy without what only happens as a file begins or ends: exposure that settles, a fade, a torn picture."""
    inner = energy[END_PICTURES:-END_PICTURES]
    if not len(inner):  # all of the clip is its ends
        return energy
    ends = np.ones(len(energy), bool)
    ends[END_PICTURES:-END_PICTURES] = False
    return np.where(ends & (energy > END_TIMES * inner.max()), np.median(inner), energy)


def _on_grid(
    time_s: Float[np.ndarray, " n"], values: Float[np.ndarray, "n channels"], dt: float
) -> Float[np.ndarray, "samples channels"]:
    """Values on an even grid that begins at the first time."""
    grid = np.arange(time_s[0], time_s[-1], dt)
    return np.stack([np.interp(grid, time_s, channel) for channel in values.T], axis=1)


def _normalised_correlation(
    a: Float[np.ndarray, "n channels"], b: Float[np.ndarray, "m channels"], minimum: int
) -> tuple[np.ndarray, Float[np.ndarray, " lags"], Float[np.ndarray, " lags"]]:
    """Pearson correlation of a[i + lag] and b[i] over what overlaps, for all lags with enough overlap.

    Each channel's own mean over the overlap is taken away; covariances and variances are summed over channels.

    Returns:
        Lags, correlations, and the share of the shorter signal that overlaps.
    """
    size = fast_size(len(a) + len(b))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)  # against cancellation in the sums below

    def correlate(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(x, size, axis=0) * np.conj(np.fft.rfft(y, size, axis=0))
        full = np.fft.irfft(spectrum, size, axis=0)
        return np.concatenate([full[size - len(b) + 1 :], full[: len(a)]])

    ones_a, ones_b = np.ones((len(a), 1)), np.ones((len(b), 1))
    n = np.maximum(np.round(correlate(ones_a, ones_b)), 1)
    sum_a, sum_b = correlate(a, ones_b), correlate(ones_a, b)
    var_a = (correlate(a * a, ones_b) - sum_a**2 / n).sum(axis=1)
    var_b = (correlate(ones_a, b * b) - sum_b**2 / n).sum(axis=1)
    cov = (correlate(a, b) - sum_a * sum_b / n).sum(axis=1)
    lags = np.arange(-(len(b) - 1), len(a))
    floor = 1e-6 * len(a) * float(a.var(axis=0).sum() + b.var(axis=0).sum())
    values = cov / np.sqrt(np.maximum(var_a, floor) * np.maximum(var_b, floor))
    keep = n[:, 0] >= minimum
    return lags[keep], values[keep], n[keep, 0] / min(len(a), len(b))


def _spread(
    lags_s: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], peak: int, overlap_s: float
) -> tuple[float, float]:
    """Standard deviation of a peak's place, and how many standard deviations its height is from chance.

    The first is the unexplained share over curvature and number of independent samples, the second is
    Fisher's z-transform with that number.

    The peak is taken as a Gaussian of the width it has at half its height (for the delay of two noisy
    signals see Knapp & Carter 1976, Section IV; here the "noise" is what the other view does not see).
    """
    low = np.flatnonzero(values < values[peak] / 2)
    left, right = low[low < peak], low[low > peak]
    reach = [lags_s[peak] - lags_s[left[-1]]] if len(left) else []
    reach += [lags_s[right[0]] - lags_s[peak]] if len(right) else []
    sigma_s = (min(reach) if reach else overlap_s) / np.sqrt(2 * np.log(2))
    independent = max(1.0, overlap_s / (2 * sigma_s))
    r = float(np.clip(values[peak], 1e-3, 0.9999))
    score = np.arctanh(r) * np.sqrt(max(independent - 3, 0.0))
    return float(sigma_s * np.sqrt((1 - r * r) / (r * r * independent))), float(score)
