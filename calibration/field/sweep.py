"""Will a sweep hold together? A few of its pictures: do neighbours overlap, does depth show, did the light change."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.calibration.field.matching import Features, Pair, features, match
from devrf.capture.srgb import linear_from_srgb
from devrf.capture.survey import Picture

ENOUGH = 30  # verified matches of two neighbours: COLMAP's least for a pose
WIDE_ENOUGH = 60  # verified matches of two pictures far apart: depth can be told from them
GAPS = (1, 2, 4, 8, 16)  # pictures, tried until too little is shared
LOOP_SHARE = 0.15  # of the sweep, at its start and its end
CLOSES = 15  # verified matches: COLMAP keeps a pair from here on
NEAR_WHITE, NEAR_BLACK = 245.0, 10.0  # levels whose ratio says nothing about light
FEWEST_COLOURS = 20


@dataclass(frozen=True)
class SweepGlance:
    """What some pictures of a sweep tell.

    Attributes:
        linked: Share of successive pictures that overlap; breaks: where they do not, positions among the pictures.
        depth_share: Share of matches that need depth to be explained, in the upper quarter of pictures far apart;
            None where no pictures far apart share enough.
        closes: Whether the end sees what the start saw.
        light_stops: Light of each picture against the first, by what neighbours share [n, 3], stops; NaN after a break.
    """

    linked: float
    breaks: tuple[int, ...]
    depth_share: float | None
    closes: bool
    light_stops: Float[np.ndarray, "n 3"]


def glance_at_sweep(found: Sequence[Features], between: Callable[[int], Picture | None]) -> SweepGlance:
    """Look at pictures in the order of the walk.

    Args:
        found: Their features.
        between: A picture from between picture n and the next; None where there is none.
    """
    neighbours = [match(a, b) for a, b in zip(found, found[1:], strict=False)]
    breaks = tuple(
        n for n, pair in enumerate(neighbours) if not _linked(pair, found[n], found[n + 1], between(n))
    )
    return SweepGlance(
        1 - len(breaks) / max(1, len(neighbours)),
        breaks,
        _depth_share(found, neighbours),
        _closes(found),
        _light(found, neighbours),
    )


def light_ratio_stops(a: Features, b: Features, pair: Pair) -> Float[np.ndarray, "3"]:
    """How much brighter the second picture shows what both see, per channel, stops; NaN where too little is shared."""
    first, second = a.rgb[pair.first], b.rgb[pair.second]
    both = np.concatenate([first, second], axis=1)
    good = (both.max(axis=1) < NEAR_WHITE) & (both.min(axis=1) > NEAR_BLACK)
    if good.sum() < FEWEST_COLOURS:
        return np.full(3, np.nan)
    return np.median(
        np.log2(linear_from_srgb(second[good] / 255) / linear_from_srgb(first[good] / 255)), axis=0
    )


def _linked(pair: Pair, a: Features, b: Features, between: Picture | None) -> bool:
    if len(pair) >= ENOUGH:
        return True
    if between is None:
        return False
    middle = features(between)
    return min(len(match(a, middle)), len(match(middle, b))) >= ENOUGH


def _depth_share(found: Sequence[Features], neighbours: Sequence[Pair]) -> float | None:
    """By the widest pair of each picture that shares enough."""
    shares = []
    for n, pair in enumerate(neighbours):
        widest = None
        for gap in GAPS:
            if n + gap >= len(found):
                break
            pair = pair if gap == 1 else match(found[n], found[n + gap])
            if len(pair) < WIDE_ENOUGH:
                break
            widest = 1 - pair.flat_share
        if widest is not None:
            shares.append(widest)
    return float(np.quantile(shares, 0.75)) if shares else None


def _closes(found: Sequence[Features]) -> bool:
    ends = max(1, round(LOOP_SHARE * len(found)))
    return any(len(match(a, b)) >= CLOSES for a in found[-ends:] for b in found[:ends])


def _light(found: Sequence[Features], neighbours: Sequence[Pair]) -> Float[np.ndarray, "n 3"]:
    steps = [light_ratio_stops(found[n], found[n + 1], pair) for n, pair in enumerate(neighbours)]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(np.array(steps).reshape(-1, 3), axis=0)])
