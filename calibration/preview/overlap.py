"""Will a sweep hold together, and does it know a fixed camera's view? What a few of its pictures share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from devrf.calibration.preview.matching import Features, Pair, features, match
from devrf.capture.ingest.survey import Picture

ENOUGH = 30  # verified matches of two neighbours: COLMAP's least for a pose
WIDE_ENOUGH = 60  # verified matches of two pictures far apart: depth can be told from them
GAPS = (1, 2, 4, 8, 16)  # pictures, tried until too little is shared
VERIFIED = 12  # matches of two pictures that are no chance


@dataclass(frozen=True)
class SweepOverlap:
    """What some pictures of a sweep share.

    Attributes:
        linked: Share of successive pictures that overlap.
        breaks: Where they do not, positions among the pictures.
        depth_share: Share of matches that need depth to be explained, in the upper quarter of pictures far apart;
            None where no pictures far apart share enough.
    """

    linked: float
    breaks: tuple[int, ...]
    depth_share: float | None


def overlap_of(found: Sequence[Features], between: Callable[[int], Picture | None]) -> SweepOverlap:
    """Look at pictures in the order of the walk.

    Args:
        found: Their features.
        between: A picture from between picture n and the next; None where there is none.
    """
    neighbours = [match(a, b) for a, b in zip(found, found[1:], strict=False)]
    breaks = tuple(n for n, pair in enumerate(neighbours) if not _linked(pair, found[n : n + 2], between(n)))
    depth = [
        share for n in range(len(neighbours)) if (share := _depth_share(found[n:], neighbours[n])) is not None
    ]
    return SweepOverlap(
        1 - len(breaks) / max(1, len(neighbours)), breaks, float(np.quantile(depth, 0.75)) if depth else None
    )


def shared_features(view: Features, sweep: Sequence[Features]) -> int:
    """How many features of a fixed camera's view any picture of the sweep shows too."""
    pairs = [match(view, other) for other in sweep]
    return len({int(n) for pair in pairs if len(pair) >= VERIFIED for n in pair.first})


def _linked(pair: Pair, ends: Sequence[Features], between: Picture | None) -> bool:
    if len(pair) >= ENOUGH or between is None:
        return len(pair) >= ENOUGH
    middle = features(between)
    return min(len(match(end, middle)) for end in ends) >= ENOUGH


def _depth_share(found: Sequence[Features], neighbour: Pair) -> float | None:
    """Of the first picture, by the widest pair with a later one that shares enough."""
    widest = None
    for gap in GAPS:
        if gap >= len(found):
            break
        pair = neighbour if gap == 1 else match(found[0], found[gap])
        if len(pair) < WIDE_ENOUGH:
            break
        widest = 1 - pair.flat_share
    return widest
