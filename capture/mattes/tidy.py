"""From a raw mask to one of a subject: no specks, no pinholes; and back to the picture's size with a soft edge."""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

SPECK = 0.02  # of the largest piece: smaller pieces are noise, leaves, reflections
# Of the subject: smaller holes are noise (larger ones, such as below an arm, are seen through).
PINHOLE = 0.01
RIM_PX = 1  # the outermost pixels mix subject and background


def tidy(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without specks and pinholes."""
    kept = _without_small(mask, SPECK, of_largest=True)
    return ~_without_small(~kept, PINHOLE, of_largest=False, whole=int(kept.sum()))


def eroded(mask: Bool[np.ndarray, "h w"], radius: int = RIM_PX) -> Bool[np.ndarray, "h w"]:
    """Without its outermost pixels; the picture's border is no edge of the subject."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE).astype(bool)


def soft(mask: Bool[np.ndarray, "h w"], width: int, height: int) -> UInt8[np.ndarray, "height width"]:
    """The mask at another size, 255 is the subject; where it is enlarged its edge is soft."""
    small = mask.astype(np.uint8) * 255
    shrinks = width <= mask.shape[1]
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)


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
