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

    @property
    def above(self) -> bool:
        """Whether the whole interval lies above 0."""
        return self.half is not None and self.mean - self.half > 0

    @property
    def below(self) -> bool:
        """Whether the whole interval lies below 0."""
        return self.half is not None and self.mean + self.half < 0

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
    n, half = len(apart), None
    if n > 1:
        half = float(t.ppf((1 + CONFIDENCE) / 2, n - 1) * apart.std(ddof=1) / np.sqrt(n))
    return Gain(float(apart.mean()), half, tuple(float(a) for a in apart))
