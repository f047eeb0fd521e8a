"""By how much later each camera took its pictures than its clock says: seen in what tracking leaves unexplained.

Points go one way in space; a camera whose clock is wrong shows them a little farther along it, or less far. Tracks are
a compromise between all cameras, which hides a part of that; where they follow what was seen, it adds up over a few
moments. When all cameras are late together nothing is seen: their median clock stays.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

FORGETS = 0.7  # of its weight, that a moment keeps at the next
LEAST_WAY = 0.5  # pixels that a point has to go for it to say when it was seen there
FEWEST_POINTS = 50  # of a camera at one moment
FEWEST_CAMERAS = 2  # at one moment: one says nothing of itself
ERROR_PX = 0.5  # that the tracks of a whole picture may be off by
CLEAR = 0.1  # share of the time between moments that an offset is worth
SIGMAS = 4.0  # standard deviations that it needs


class Late(NamedTuple):
    """What one picture shows: weighted sums over points.

    Attributes:
        product: Of what is left over, times the way from the last moment to this, in squared pixels.
        square: Of the squared way.
        count: Of 1.
    """

    product: float
    square: float
    count: float


class Seen(NamedTuple):
    """What one moment shows.

    Attributes:
        offset: In the scene's time [c].
        weight: 0 where nothing was seen [c].
        unsure: Offset that an error of `ERROR_PX` pretends [c].
    """

    offset: Float[np.ndarray, " c"]
    weight: Float[np.ndarray, " c"]
    unsure: Float[np.ndarray, " c"]


class Offsets:
    """Offsets of cameras, moment by moment.

    Attributes:
        now: By how much later pictures are taken, in the scene's time [c].
        seen: Of each moment that showed any.
    """

    def __init__(self, now: Float[np.ndarray, " c"], follow: bool) -> None:
        """Begin.

        Args:
            now: Offsets that are known.
            follow: Go on to what is seen; else `now` stays.
        """
        self.now, self.seen = now, list[Seen]()
        self._follow = follow
        self._sum, self._weight = np.zeros((2, len(now)))

    def add(self, late: Mapping[int, Late], gap: float) -> None:
        """What pictures of one moment show.

        Args:
            late: By camera.
            gap: Between moments, in the scene's time.
        """
        left, weight, unsure = np.zeros((3, len(self.now)))
        for camera, one in late.items():
            if one.square > 0:
                left[camera], weight[camera] = gap * one.product / one.square, one.square
                unsure[camera] = gap * ERROR_PX * (one.count / one.square) ** 0.5
        if (weight > 0).sum() < FEWEST_CAMERAS:
            return
        self.seen.append(Seen(self.now + left, weight, unsure))
        if self._follow:
            self._sum = FORGETS * self._sum + weight * self.seen[-1].offset
            self._weight = FORGETS * self._weight + weight
            now = np.where(self._weight > 0, self._sum / np.maximum(self._weight, 1e-9), self.now)
            self.now = now - np.median(now)


def clear_offsets(seen: Sequence[Seen], gap: float) -> Float[np.ndarray, " c"] | None:
    """Offsets from the median of all cameras, if one of them is no chance; None: all clocks may be right."""
    if not seen:
        return None
    offset, weight, unsure = (np.stack(part) for part in zip(*seen, strict=True))
    mean, total = _mean(seen), np.maximum(weight.sum(0), 1e-9)
    std = np.sqrt((weight**2 * (offset - mean) ** 2).sum(0)) / total  # if moments are independent
    least = np.maximum(np.maximum(CLEAR * gap, SIGMAS * std), (weight * unsure).sum(0) / total)
    apart = mean - np.median(mean)
    return apart if (np.abs(apart) > least).any() else None


def settled(seen: Sequence[Seen]) -> Float[np.ndarray, " c"]:
    """Offsets from the median of all cameras, of moments after the first half of what was seen."""
    weight = np.cumsum([one.weight.sum() for one in seen])
    mean = _mean([one for one, so_far in zip(seen, weight, strict=True) if 2 * so_far >= weight[-1]])
    return mean - np.median(mean)


def _mean(seen: Sequence[Seen]) -> Float[np.ndarray, " c"]:
    """Weighted mean of offsets; 0 where none was seen."""
    offset, weight, _ = (np.stack(part) for part in zip(*seen, strict=True))
    return (weight * offset).sum(0) / np.maximum(weight.sum(0), 1e-9)
