"""When cameras film together, by clips that begin and end at times of their own."""

from collections.abc import Sequence
from itertools import combinations


def span_of(filmed: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """From the first to the last moment at which two cameras film at once, or one where there is only one; seconds.

    None where no two cameras ever do.

    Args:
        filmed: From when to when each camera films, on one clock.
    """
    shared = [(max(a[0], b[0]), min(a[1], b[1])) for a, b in combinations(filmed, 2)]
    shared = [(begin, end) for begin, end in shared if begin < end] if len(filmed) > 1 else list(filmed)
    return (min(begin for begin, _ in shared), max(end for _, end in shared)) if shared else None
