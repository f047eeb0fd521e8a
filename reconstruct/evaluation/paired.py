"""What a difference between pairs is worth: of trainings, when there are few of them, and of views of one clip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t

CONFIDENCE = 0.95
# of a clip: fewer say nothing, more depend on each other (docs/report.md: what such intervals hold)
STRETCHES = 4
LEAST_MOMENTS = 2 * STRETCHES


@dataclass(frozen=True)
class Gain:
    """Mean of paired differences, and the interval in which the true mean lies with CONFIDENCE.

    Attributes:
        mean: Of all pairs.
        half: Half the interval's length; None for a single pair, of which nothing can be told.
        by_pair: Every difference.
    """

    mean: float
    half: float | None
    by_pair: tuple[float, ...]

    def side(self) -> int:
        """1 where the whole interval lies above 0, -1 where it lies below, else 0."""
        return 0 if self.half is None or abs(self.mean) <= self.half else (1 if self.mean > 0 else -1)

    @property
    def nothing(self) -> bool:
        """Whether no pair differs at all."""
        return not any(self.by_pair)


def paired_gain(with_it: Sequence[float], without: Sequence[float]) -> Gain:
    """Difference of pairs, with Student's interval of the mean (Gosset, Biometrika 6, 1908).

    It takes the differences for normal, which a handful of seeds can neither show nor refute. A bootstrap would
    not: of three differences it has ten distinct samples, and its interval is far too short.

    Raises:
        ValueError: There are no pairs, or some have no partner.
    """
    if not with_it or len(with_it) != len(without):
        raise ValueError(f"{len(with_it)} and {len(without)} values do not pair up")
    apart = np.subtract(with_it, without)
    by_pair = tuple(float(a) for a in apart)
    return Gain(float(apart.mean()), half_of_interval(by_pair, CONFIDENCE), by_pair)


def gain_over_time(with_it: Sequence[float], without: Sequence[float], time: Sequence[float | int]) -> Gain:
    """Mean difference of two models over the same views, with the interval that moments like these leave open.

    Where one model is better it is better shortly after, too: forty views are far fewer than forty measurements. So the
    clip is cut into STRETCHES of time, each with the views of all cameras in it, and Student's interval is taken of
    their means (Ibragimov and Müller, Journal of Business & Economic Statistics 28, 2010).

    Args:
        with_it, without: A measure of both models on each view.
        time: When each view was taken; views at rest: their place along the sweep.
    Returns:
        `by_pair` holds the stretches' means. There is no interval where there are fewer than LEAST_MOMENTS moments.
    """
    apart = np.subtract(with_it, without)[np.argsort(time, kind="stable")]
    mean = float(apart.mean())
    if len(set(time)) < LEAST_MOMENTS:
        return Gain(mean, None, (mean,))
    stretches = tuple(float(part.mean()) for part in np.array_split(apart, STRETCHES))
    return Gain(mean, half_of_interval(stretches, CONFIDENCE), stretches)


def gain_within_clips(
    with_it: Sequence[float], without: Sequence[float], clip: Sequence[str], time: Sequence[float]
) -> Gain:
    """Mean difference of two models over pictures of the very clips that they explain, with its interval.

    That one model is better the farther something has gone is no chance there, so what drifts along a clip does not
    count: each clip is cut into STRETCHES of time, and how much their means differ by chance is told by those that
    follow each other (successive differences: Wolter, Journal of the American Statistical Association 79, 1984).

    Args:
        with_it, without: A measure of both models on each picture.
        clip: Which one each picture is of.
        time: When it was taken.
    Returns:
        `by_pair` holds the stretches' means, each of two pictures or more. There is no interval where fewer follow each
        other than in one clip of LEAST_MOMENTS pictures.
    """
    apart, clips = np.subtract(with_it, without), np.array(clip)
    mean, stretches, steps = float(apart.mean()), [], []
    for name in dict.fromkeys(clip):
        mine = np.flatnonzero(clips == name)
        mine = mine[np.argsort(np.array(time)[mine], kind="stable")]
        parts = np.array_split(apart[mine], max(1, min(STRETCHES, len(mine) // 2)))
        means = [float(part.mean()) for part in parts]
        stretches += means
        steps += np.diff(means).tolist()
    if len(steps) < STRETCHES - 1:
        return Gain(mean, None, (mean,))
    std = np.sqrt(np.square(steps).mean() / 2 / len(stretches))
    half = float(t.ppf((1 + CONFIDENCE) / 2, 2 * len(steps) / 3) * std)
    return Gain(mean, half, tuple(stretches))


def gain_text(gain: Gain, unit: str = "dB") -> str:
    """A gain with what chance leaves open."""
    if gain.half is None:
        return f"{gain.mean:+.2f} {unit}, of too few moments to tell it from chance"
    return f"{gain.mean:+.2f} ± {gain.half:.2f} {unit}"


def half_of_interval(by_pair: Sequence[float], confidence: float) -> float | None:
    """Half of Student's interval of the mean; None for a single value."""
    n = len(by_pair)
    if n < 2:
        return None
    return float(t.ppf((1 + confidence) / 2, n - 1) * np.std(by_pair, ddof=1) / np.sqrt(n))
