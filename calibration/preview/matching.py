"""Two pictures of one scene: what both see, and whether depth shows between them.

Small pictures and few features: enough to say that two views overlap, not to calibrate from.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

SIDE_PX = 640  # of the pictures that are compared
MOST_FEATURES = 1500
RATIO = 0.8  # Lowe, IJCV 2004
EPIPOLAR_PX = 2.0  # at `SIDE_PX`; COLMAP allows 4 of full pictures
FLAT_PX = 1.5  # matches without depth stay within it of a smooth map ...
HOMOGRAPHY_PX = 5.0  # ... which begins with a homography, that distortion of lenses leaves by this much
FEWEST = 8  # matches of which an epipolar geometry can be told


@dataclass(frozen=True)
class Features:
    """SIFT features of one picture.

    Attributes:
        xy: Places, pixels of the small picture [n, 2].
        descriptors: Unit vectors, RootSIFT (Arandjelovic & Zisserman, CVPR 2012) [n, 128].
    """

    xy: Float[np.ndarray, "n 2"]
    descriptors: Float[np.ndarray, "n 128"]


@dataclass(frozen=True)
class Pair:
    """What two pictures share.

    Attributes:
        first, second: Features that match and agree on one epipolar geometry [n] each.
        flat_share: Share of them on one smooth map from picture to picture; 1: no depth shows (or nothing is shared).
    """

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    flat_share: float

    def __len__(self) -> int:
        return len(self.first)


def features(picture: UInt8[np.ndarray, "height width 3"]) -> Features:
    """Find features of an RGB picture."""
    scale = min(1.0, SIDE_PX / max(picture.shape[:2]))
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA).astype(np.uint8)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    points, found = cv2.SIFT.create(nfeatures=MOST_FEATURES, contrastThreshold=0.02).detectAndCompute(
        grey, None
    )
    if found is None or not len(points):
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    xy = np.array([point.pt for point in points], dtype=np.float64)
    descriptors = np.sqrt(found / np.maximum(found.sum(axis=1, keepdims=True), 1e-6)).astype(np.float32)
    return Features(xy, descriptors)


def match(first: Features, second: Features) -> Pair:
    """Mutual nearest neighbours that pass the ratio test and agree on one epipolar geometry."""
    none = np.zeros(0, np.int64)
    nothing = Pair(none, none, 1.0)
    if min(len(first.xy), len(second.xy)) < FEWEST:
        return nothing
    similarity = first.descriptors @ second.descriptors.T
    best = similarity.argmax(axis=1)
    rows = np.arange(len(best))
    top = similarity[rows, best]
    similarity[rows, best] = -1.0
    distance, next_distance = (np.sqrt(np.maximum(2 - 2 * s, 1e-12)) for s in (top, similarity.max(axis=1)))
    similarity[rows, best] = top
    good = (similarity.argmax(axis=0)[best] == rows) & (distance < RATIO * next_distance)
    a, b = rows[good], best[good]
    if len(a) < FEWEST:
        return nothing
    inside = _epipolar(first.xy[a], second.xy[b])
    a, b = a[inside], b[inside]
    if len(a) < FEWEST:
        return nothing
    return Pair(a, b, _flat_share(first.xy[a], second.xy[b]))


def _flat_share(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> float:
    """Share of matches that a homography and, for the lens, a cubic polynomial explain.

    A camera that only turns, or one that sees a plane, leaves nothing else.
    """
    cv2.setRNGSeed(0)
    H, near = cv2.findHomography(a, b, cv2.RANSAC, HOMOGRAPHY_PX)
    if H is None or near is None:
        return 0.0
    rest = b - cv2.perspectiveTransform(a[:, None], H)[:, 0]
    x, y = ((a - a.mean(0)) / SIDE_PX).T
    powers = np.column_stack([x**i * y**j for i in range(4) for j in range(4 - i)])
    fit = np.asarray(near).reshape(-1) > 0
    for _ in range(3):  # once more on what fits, so that single wrong ones do not bend it
        if fit.sum() <= 2 * powers.shape[1]:
            break
        left = np.linalg.norm(rest - powers @ np.linalg.lstsq(powers[fit], rest[fit], rcond=None)[0], axis=1)
        fit = left < FLAT_PX
    return float(fit.mean())


def _epipolar(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, " n"]:
    still = np.linalg.norm(a - b, axis=1) < EPIPOLAR_PX
    # a camera that stood: every epipole fits, and OpenCV asserts where it finds no model
    if still.mean() > 0.5:
        return still
    cv2.setRNGSeed(0)
    F, inside = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, EPIPOLAR_PX, 0.999, 2000)
    if F is None or inside is None:
        return np.zeros(len(a), dtype=bool)
    return np.asarray(inside).reshape(-1) > 0
