"""Whether a fixed camera's picture stands still: stabilisation, a touched tripod, zoom, focus that breathes.

Corners of the first picture are followed into later ones (Lucas-Kanade, both ways); the similarity that most of them
agree on is the background's motion, and what moves in the scene is left out as outliers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

CORNERS = 200
CORNER_QUALITY = 0.01
CORNER_DISTANCE_PX = 10  # corners all over the picture, not all on one poster
WINDOW_PX = 15
PYRAMID_LEVELS = 2  # backgrounds move by a few pixels; coarser windows would follow a large subject
ROUND_TRIP_PX = 0.5  # a corner that does not come back was lost
AGREE_PX = 0.5  # of the small picture; followed corners are good to about 0.1
FEWEST_CORNERS = 20
# Of those that come back; fewer: the subject fills the picture, or everything moves in its own way.
AGREEING_SHARE = 0.5


@dataclass(frozen=True)
class BackgroundMotion:
    """How a picture's background lies against another picture of the same camera.

    Attributes:
        shift_px: Root mean square displacement by translation and turn, without zoom.
        scale: Its size over the other's.
    """

    shift_px: float
    scale: float


def find_corners(grey: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "n 1 2"] | None:
    """Corners to follow; None where there are too few."""
    corners = cv2.goodFeaturesToTrack(grey, CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
    return None if corners is None or len(corners) < FEWEST_CORNERS else np.asarray(corners).reshape(-1, 1, 2)


def follow(
    first: UInt8[np.ndarray, "height width"],
    other: UInt8[np.ndarray, "height width"],
    corners: Float[np.ndarray, "n 1 2"],
) -> BackgroundMotion | None:
    """Motion of the background, from where `corners` of `first` are found in `other`."""
    there, found = _followed(first, other, corners)
    back, returned = _followed(other, first, there)
    missed = np.linalg.norm((back - corners)[:, 0], axis=1)
    kept = found & returned & (missed < ROUND_TRIP_PX)
    if kept.sum() < FEWEST_CORNERS:
        return None
    similarity, agree = cv2.estimateAffinePartial2D(
        corners[kept], there[kept], ransacReprojThreshold=AGREE_PX
    )
    if similarity is None or agree.sum() < max(FEWEST_CORNERS, AGREEING_SHARE * kept.sum()):
        return None
    scale = float(np.hypot(similarity[0, 0], similarity[1, 0]))
    height, width = first.shape
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    moved = similarity[:, :2] @ centre + similarity[:, 2] - centre
    turn = float(np.arctan2(similarity[1, 0], similarity[0, 0]))
    # root mean square distance of a picture's pixels from its centre
    radius = np.hypot(width, height) / np.sqrt(12)
    return BackgroundMotion(float(np.hypot(np.linalg.norm(moved), turn * radius)), scale)


def _followed(
    first: UInt8[np.ndarray, "height width"],
    other: UInt8[np.ndarray, "height width"],
    corners: Float[np.ndarray, "n 1 2"],
) -> tuple[Float[np.ndarray, "n 1 2"], Bool[np.ndarray, " n"]]:
    """Where corners went, and which were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first, other, corners, np.empty_like(corners), winSize=(WINDOW_PX, WINDOW_PX), maxLevel=PYRAMID_LEVELS
    )
    return np.asarray(there), found.ravel() == 1
