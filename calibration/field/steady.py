"""Does a camera stand or move? The background of a few pictures spread over its clip."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.calibration.rigs.bump import FEATURES, MIN_BACKGROUND, background_motion, normalised

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
    start = cv2.goodFeaturesToTrack(middle, FEATURES, 0.01, 8)
    if start is None or len(start) < MIN_BACKGROUND:
        return Steadiness(None, np.nan, 0.0)
    height, width = middle.shape
    frame = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    moved = []
    for n, grey in enumerate(greys):
        if n == len(greys) // 2:
            continue
        found = background_motion(middle, normalised(grey), np.asarray(start, np.float32))
        if found is not None:
            matrix, _ = found
            steps = frame @ matrix[:, :2].T + matrix[:, 2] - frame
            moved.append(float(np.linalg.norm(steps, axis=1).max()) / width)
    share = len(moved) / (len(greys) - 1)
    typical = float(np.median(moved)) if moved else np.nan
    return Steadiness(share >= FOUND and typical <= STANDS, typical, share)
