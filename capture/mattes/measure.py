"""What a matte says about itself: how much it shows, holes within it, a rim of the background's colour.

Colours are compared with the mean colour of the subject and of the background nearby, each over a window around
the pixel. A gap below an arm has the background's colour and is no hole.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

RIM_PX = 2  # a good matte's outermost pixels mix both; those behind them do not
EDGE_PX = 4  # to either side of the edge colours are not taken for the subject's or the background's
APART = 24.0  # grey levels between subject and background nearby; what is closer cannot be judged
WINDOW = 0.06  # of the longer side, for colours nearby
ANY = 25  # of 255, of a small pixel: a tenth of it shows the subject
LEAST_SUBJECT = 5e-4  # of the picture: less shows no subject


@dataclass(frozen=True)
class MatteFacts:
    """Of one matte.

    Attributes:
        area: Share of the picture that is subject.
        holes: Share of the subject's area in enclosed holes that have the subject's colour.
        rim: Share of its outermost pixels nearer to the background's colour than to the subject's; None where the
            two are too alike to tell, or nothing is shown.
        small: The matte at a small size: where any of it is shown.
    """

    area: float
    holes: float
    rim: float | None
    small: Bool[np.ndarray, "h w"]


def measure(
    picture: UInt8[np.ndarray, "h w c"], matte: UInt8[np.ndarray, "h w"], small_size: tuple[int, int]
) -> MatteFacts:
    """Look at one matte; `small_size` is the (width, height) of `small`."""
    small = cv2.resize(matte, small_size, interpolation=cv2.INTER_AREA) > ANY
    shown = matte > 127
    area = float(shown.mean())
    if area < LEAST_SUBJECT:
        return MatteFacts(area, 0.0, None, small)
    filled = _without_holes(shown)
    holes = filled & ~shown
    band = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
    inner = shown & (cv2.erode(filled.astype(np.uint8), band, borderType=cv2.BORDER_REPLICATE) > 0)
    outer = cv2.dilate(filled.astype(np.uint8), band) == 0
    colours = picture[..., :3].astype(np.float32)
    side = 2 * max(round(WINDOW * max(shown.shape)), 2 * EDGE_PX + RIM_PX) + 1
    subject, near_subject = _mean_nearby(colours, inner, side)
    behind, near_behind = _mean_nearby(colours, outer, side)
    to_subject = np.linalg.norm(colours - subject, axis=-1)
    to_behind = np.linalg.norm(colours - behind, axis=-1)
    unlike = near_subject & near_behind & (np.linalg.norm(subject - behind, axis=-1) > APART)
    kernel = np.ones((2 * RIM_PX + 1, 2 * RIM_PX + 1), np.uint8)
    eroded = cv2.erode(shown.astype(np.uint8), kernel, borderType=cv2.BORDER_REPLICATE) > 0
    rim = shown & ~eroded & unlike
    judged = bool(rim.any()) and rim.sum() > 0.2 * (shown & ~eroded).sum()
    own = holes & near_subject & (to_subject < to_behind)
    return MatteFacts(
        area,
        float(own.sum() / shown.sum()),
        float((to_behind < to_subject)[rim].mean()) if judged else None,
        small,
    )


def _without_holes(shown: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """With everything filled that cannot be reached from outside."""
    around = cv2.copyMakeBorder((~shown).astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=1)
    cv2.floodFill(around, None, (0, 0), 2)
    return around[1:-1, 1:-1] != 2


def _mean_nearby(
    colours: Float32[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"], side: int
) -> tuple[Float[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Mean colour of marked pixels in a window around each pixel (of all where it has none), and where it has any."""
    weight = where.astype(np.float32)
    count = cv2.boxFilter(weight, -1, (side, side), normalize=False)
    total = cv2.boxFilter(colours * weight[..., None], -1, (side, side), normalize=False)
    some = count > 0.5
    mean = total / np.maximum(count, 1.0)[..., None]
    mean[~some] = colours[where].mean(axis=0) if where.any() else 0.0
    return mean, some
