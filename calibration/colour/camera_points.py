"""Points that two fixed cameras see at the same moment.

Features (SIFT; Lowe, IJCV 2004) of pictures of one moment are matched. Two matched ones are a point where their lines
of sight meet: that is the epipolar constraint of the calibrated cameras.
"""

from collections.abc import Iterable, Mapping
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float

from devrf.calibration.colour.surface import Pairs, View, shared_colours
from devrf.calibration.features import mutual_matches
from devrf.capture.camera import Camera

SIDE_PX = 1280  # of the longer side; finer features find no partner in another view
FEATURES = 4000
# below OpenCV's 0.04: walls and cloth are plain; wrong matches fail the ratio and the geometry
CONTRAST = 0.01
EQUALISED = (3.0, (8, 8))  # CLAHE, for matching only: cameras of other exposure find the same features
RATIO = 0.85  # second best to best descriptor
MISS_SHARE = 2.5e-3  # of the longer side, 3 px at 1280: by how much a match may miss its epipolar line
NARROW = 1e-4  # squared sine of the angle between two lines of sight, 0.6 degrees: below it depth is unknown

Features = tuple[Float[np.ndarray, "_ 2"], Float[np.ndarray, "_ 128"]]


def camera_pairs(moments: Iterable[Mapping[str, View]]) -> list[Pairs]:
    """Colours of the common points of all pairs of cameras.

    Args:
        moments: For each moment, the cameras' pictures of it.
    """
    found: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for views in moments:
        features = {name: _features(view) for name, view in views.items()}
        for a, b in combinations(views, 2):
            points, xy_a, xy_b = _meeting(views[a].camera, features[a], views[b].camera, features[b])
            colours, usable = shared_colours(points, views[a], views[b], (xy_a, xy_b))
            place = xy_b[usable] / views[b].camera.width
            found.setdefault((a, b), []).append((colours[usable], place))
    return [
        Pairs(a, b, np.concatenate([c for c, _ in parts]), np.concatenate([p for _, p in parts]))
        for (a, b), parts in found.items()
    ]


def _features(view: View) -> Features:
    """Places at full size, the first pixel's centre at 0.5, and RootSIFT descriptors."""
    h, w = view.rgb.shape[:2]
    scale = min(1.0, SIDE_PX / max(h, w))
    grey = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
    grey = cv2.resize(grey, (round(w * scale), round(h * scale)), interpolation=cv2.INTER_AREA)
    equal = cv2.createCLAHE(*EQUALISED).apply(grey)
    sift = cv2.SIFT.create(nfeatures=FEATURES, contrastThreshold=CONTRAST)
    points, descriptors = sift.detectAndCompute(np.asarray(equal, np.uint8), None)
    if not len(points):
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    return (np.array([p.pt for p in points]) + 0.5) / scale, np.sqrt(share).astype(np.float32)


def _meeting(
    a: Camera, of_a: Features, b: Camera, of_b: Features
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Points where lines of sight of matched features meet, and the features' places."""
    i, j = mutual_matches(of_a[1], of_b[1], RATIO)
    xy_a, xy_b = of_a[0][i], of_b[0][j]
    points, before = _between(a, xy_a, b, xy_b)
    miss = np.maximum(*(np.linalg.norm(c.project(points) - xy, axis=1) / max(c.width, c.height)
                        for c, xy in ((a, xy_a), (b, xy_b))))  # fmt: skip
    good = before & (miss < MISS_SHARE)
    return points[good], xy_a[good], xy_b[good]


def _between(
    a: Camera, xy_a: Float[np.ndarray, "n 2"], b: Camera, xy_b: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Where two lines of sight come nearest to each other, and whether that is known and before both cameras."""
    da, db, base = a.directions(xy_a), b.directions(xy_b), b.centre - a.centre
    cosine, along_a, along_b = (da * db).sum(axis=1), da @ base, db @ base
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    s, t = (along_a - cosine * along_b) / sine2, (cosine * along_a - along_b) / sine2
    points = 0.5 * (a.centre + s[:, None] * da + b.centre + t[:, None] * db)
    return points, (s > 0) & (t > 0) & (sine2 > NARROW)
