"""From a raw mask to one of a subject: no specks, no pinholes."""

import cv2
import numpy as np
from jaxtyping import Bool

SPECK = 0.02  # of the largest piece: smaller pieces are noise, leaves, reflections
# Of the subject: smaller holes are noise (larger ones, such as below an arm, are seen through).
PINHOLE = 0.01


def tidy(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without specks and pinholes."""
    kept = _without_small(mask, SPECK, of_largest=True)
    return ~_without_small(~kept, PINHOLE, of_largest=False, whole=int(kept.sum()))


def _without_small(
    mask: Bool[np.ndarray, "h w"], share: float, of_largest: bool, whole: int = 0
) -> Bool[np.ndarray, "h w"]:
    """Without connected pieces below a share of the largest one, or of `whole` pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if count < 2:
        return mask
    sizes = stats[:, cv2.CC_STAT_AREA]
    least = share * (sizes[1:].max() if of_largest else whole)
    keep = sizes >= least
    keep[0] = False
    return keep[np.asarray(labels, np.int32)]
