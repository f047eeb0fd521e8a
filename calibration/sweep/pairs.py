"""Which pictures of a sweep are matched, in the order of their worth.

A film's neighbours overlap, so a long film needs its neighbours, jumps of growing length, and a sample of
far pairs that closes loops; the other pairs are matched only where the result is weak. Photos need all
pairs. Where time does not allow that, the list is cut at its end: nearest first, by place where it is known,
else in the order they were taken.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.capture.system.spread import spread

EXHAUSTIVE_UP_TO = 70  # frames of a film; all pairs beyond that take longer than the features
OVERLAP = 8  # neighbours in a longer film
LOOP_PICTURES = 28  # of a longer film are matched with each other, to close loops

Pair = tuple[str, str]


@dataclass(frozen=True)
class PairPlan:
    """Pairs by worth, best first; the first `wanted` are matched if time allows, the rest if need be."""

    pairs: list[Pair]
    wanted: int


def plan_pairs(names: list[str], ordered: bool, places: Float[np.ndarray, "n 3"] | None = None) -> PairPlan:
    """Plan the pairs of a sweep.

    Args:
        names: Pictures, in the order they were taken.
        ordered: They are frames of one film.
        places: Where each was taken, metres; NaN where that is not known.
    """
    n = len(names)
    first, second = np.triu_indices(n, 1)
    step = second - first
    sample = np.zeros(n, dtype=bool)
    sample[spread(range(n), LOOP_PICTURES)] = True
    rank = np.full(len(step), 3)
    rank[sample[first] & sample[second]] = 2
    rank[(step > OVERLAP) & (step & (step - 1) == 0)] = 1
    rank[step <= OVERLAP] = 0
    apart = np.zeros(len(step))
    if places is not None:
        known = np.linalg.norm(places[first] - places[second], axis=1)
        apart = np.where(np.isfinite(known), known, 0.0)  # of unknown place: not left out for it
        rank = np.where(rank == 0, 0, 1)
    order = np.lexsort((first, step, apart, rank))
    pairs = [(names[i], names[j]) for i, j in zip(first[order].tolist(), second[order].tolist(), strict=True)]
    everything = not ordered or n <= EXHAUSTIVE_UP_TO
    return PairPlan(pairs, len(pairs) if everything else int((rank < 3).sum()))
