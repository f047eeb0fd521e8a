"""What a difference between two models is worth that were measured on the same test views.

Views of one moment are alike, and so are those of neighbouring moments: where one model is better at a time it is
better shortly after, too. Forty views are therefore far fewer than forty measurements, and an interval that takes them
for independent is several times too short. Here the clip is cut into BLOCKS stretches of time, each with the views of
all cameras in it, and Student's interval is taken of the stretches' means (Ibragimov and Müller, Journal of Business &
Economic Statistics 28, 2010), which needs no more than that stretches hardly depend on each other.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from devrf.reconstruct.paired import CONFIDENCE, Gain, half_of_interval

BLOCKS = (
    4  # fewer say nothing, more depend on each other: in simulated courses this covers best (docs/report.md)
)
LEAST_MOMENTS = 2 * BLOCKS


def gain_over_time(
    with_it: Sequence[float], without: Sequence[float], time: Sequence[float], cameras: int = 1
) -> Gain:
    """Mean difference of two models over views, with the interval that moments like these leave open.

    Args:
        with_it, without: A measure of both models on each view.
        time: When each view was taken; views at rest: their place along the sweep.
        cameras: How many cameras saw each moment.
    Returns:
        `by_pair` holds the stretches' means. There is no interval where there are fewer than LEAST_MOMENTS moments, or
        where the difference stays alike for longer than a stretch.
    Raises:
        ValueError: There are no views, or some have no partner or no time.
    """
    if not with_it or not len(with_it) == len(without) == len(time):
        raise ValueError(
            f"{len(with_it)}, {len(without)} values and {len(time)} times do not belong together"
        )
    apart = np.subtract(with_it, without)[np.argsort(time, kind="stable")]
    mean = float(apart.mean())
    moments = apart[: len(apart) // cameras * cameras].reshape(-1, cameras).mean(1)
    if len(moments) < LEAST_MOMENTS or correlation_length(moments) > len(moments) / BLOCKS:
        return Gain(mean, None, (mean,))
    blocks = tuple(float(block.mean()) for block in np.array_split(apart, BLOCKS))
    return Gain(mean, half_of_interval(blocks, CONFIDENCE), blocks)


def correlation_length(values: Float[np.ndarray, " n"]) -> float:
    """How many neighbours in a series count as one independent value: 1 for noise.

    The integrated autocorrelation time 1 + 2 Σ ρ_k, cut where the sum of two neighbouring ρ is no longer positive
    (Geyer, Statistical Science 7, 1992, initial positive sequence).
    """
    centred = values - values.mean()
    power = float(centred @ centred)
    if power == 0:
        return 1.0
    rho = np.correlate(centred, centred, "full")[len(values) - 1 :] / power
    pairs = rho[: len(rho) // 2 * 2].reshape(-1, 2).sum(1)
    ends = np.flatnonzero(pairs <= 0)
    return max(1.0, 2 * float(pairs[: ends[0] if len(ends) else None].sum()) - 1)
