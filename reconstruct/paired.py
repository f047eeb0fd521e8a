"""What a difference between pairs of trainings is worth, when there are few of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t

CONFIDENCE = 0.95


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

    def side(self, measures: int = 1) -> int:
        """1 where the whole interval lies above 0, -1 where it lies below, else 0.

        Args:
            measures: How many are asked of which any may decide; each has its share of the doubt (Bonferroni), so that
                with CONFIDENCE none is wrong.
        """
        half = half_of_interval(self.by_pair, 1 - (1 - CONFIDENCE) / measures)
        return 0 if half is None or abs(self.mean) <= half else (1 if self.mean > 0 else -1)

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


def half_of_interval(by_pair: Sequence[float], confidence: float) -> float | None:
    """Half of Student's interval of the mean; None for a single value."""
    n = len(by_pair)
    if n < 2:
        return None
    return float(t.ppf((1 + confidence) / 2, n - 1) * np.std(by_pair, ddof=1) / np.sqrt(n))
