"""When cameras film together, by clips that begin and end at times of their own."""

from collections.abc import Mapping, Sequence
from itertools import combinations, product

import numpy as np
from jaxtyping import Bool, Float

# At a file's edges exposure settles, microphones pop and encoders start: that is the camera's, not the scene's, and
# it lies at one place in all files. So a delay is believed only if it is found without them, too.
EDGE_S = 0.5


def inside(time_s: Float[np.ndarray, " n"], span_s: tuple[float, float]) -> Bool[np.ndarray, " n"]:
    """Which times are not at an edge of a file that lasts from `span_s[0]` to `span_s[1]`, seconds [n]."""
    return (time_s >= span_s[0] + EDGE_S) & (time_s <= span_s[1] - EDGE_S)


def span_of(filmed: Sequence[tuple[float, float]]) -> tuple[float, float] | None:
    """From the first to the last moment at which two cameras film at once, or one where there is only one; seconds.

    None where no two cameras ever do.

    Args:
        filmed: From when to when each camera films, on one clock.
    """
    shared = [(max(a[0], b[0]), min(a[1], b[1])) for a, b in combinations(filmed, 2)]
    shared = [(begin, end) for begin, end in shared if begin < end] if len(filmed) > 1 else list(filmed)
    return (min(begin for begin, _ in shared), max(end for _, end in shared)) if shared else None


def most_together(times: Mapping[str, Float[np.ndarray, " _"]], least: int) -> list[str]:
    """As many cameras as possible that film one span together, each with enough pictures in it.

    Of two choices of as many cameras, the one that film longer together; empty where there are no two.

    Args:
        times: When each camera took its pictures, ascending, on one clock, seconds.
        least: Pictures that each of them has to have in the span.
    """
    best, longest_s = list[str](), 0.0
    times = {name: t for name, t in times.items() if len(t) >= least}
    for begin, end in product({float(t[0]) for t in times.values()}, {float(t[-1]) for t in times.values()}):
        covering = [name for name, t in times.items() if t[0] <= begin and end <= t[-1]]
        names = [n for n in covering if ((times[n] >= begin) & (times[n] <= end)).sum() >= least]
        if len(names) > 1 and (len(names), end - begin) > (len(best), longest_s):
            best, longest_s = names, end - begin
    return best
