"""Does a camera stand or move? The background of a few pictures spread over its clip."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from devrf.calibration.rigs.bump import background_features, background_motion, normalised

STANDS = 0.02  # of the width; a tripod in wind stays below 0.2 %, a hand that tries to hold still does not
FOUND = 0.5  # of the pictures in which the first one's background is found again


@dataclass(frozen=True)
class Steadiness:
    """What a camera did while it filmed.

    Attributes:
        stands: Whether it stood; None where there is too little to see to tell.
        moved: Median over the pictures of how far the picture's corners went, of its width; NaN: never found again.
        found: Share of the pictures in which the first one's background was found again.
    """

    stands: bool | None
    moved: float
    found: float


def steadiness(greys: Sequence[UInt8[np.ndarray, "h w"]]) -> Steadiness:
    """Look at pictures of one clip, in order, of one size."""
    if len(greys) < 2:
        return Steadiness(None, np.nan, 0.0)
    middle = normalised(greys[len(greys) // 2])
    start = background_features(middle)
    if start is None:
        return Steadiness(None, np.nan, 0.0)
    moved = []
    for n, grey in enumerate(greys):
        if n == len(greys) // 2:
            continue
        found = background_motion(middle, normalised(grey), start)
        if found is not None:
            moved.append(float(np.linalg.norm(found[0], axis=1).max()) / middle.shape[1])
    share = len(moved) / (len(greys) - 1)
    typical = float(np.median(moved)) if moved else np.nan
    return Steadiness(share >= FOUND and typical <= STANDS, typical, share)
