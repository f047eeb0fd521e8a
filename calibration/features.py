"""Matching features of two pictures by their descriptors."""

import numpy as np
from jaxtyping import Float, Int


def mutual_matches(
    a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"], ratio: float
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Each other's nearest, clearly nearer than the next (Lowe, IJCV 2004, Section 7.1).

    Args:
        a, b: Descriptors of unit length.
        ratio: Of the distances to the best and to the second best, at most.
    Returns:
        Numbers in `a`, rising, and those of their partners in `b`.
    """
    if min(len(a), len(b)) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    likeness = a @ b.T  # of unit vectors: squared distance is 2 - 2 likeness
    best = likeness.argmax(axis=1)
    top = np.partition(likeness, -2, axis=1)[:, -2:]
    second, first = np.sqrt(np.maximum(2 - 2 * top, 0)).T
    good = (likeness.argmax(axis=0)[best] == np.arange(len(a))) & (first < ratio * second)
    return np.flatnonzero(good), best[good]
