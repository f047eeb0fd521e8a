"""Which order of pictures fits their cameras: what two share lies on epipolar lines of the right cameras only."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.scene import PosedFrame
from devrf.capture.system.spread import spread

PAIRS = 6  # of pictures that are compared, for each order: those whose cameras are neighbours in it
SIDE, FEATURES = 640, 1500  # pixels; of one picture
RATIO = 0.75  # of the nearest descriptor's distance to the second (Lowe 2004)
NEAR = 0.005  # of the picture's longer side, from an epipolar line
CONTRAST = 0.01  # of features; a quarter of the usual
# Matches that an order explains; times as many as another one: by chance 1 in 50 fits.
FEWEST, CLEARLY = 10, 3.0


def order_that_fits(orders: Sequence[Sequence[PosedFrame]]) -> int | None:
    """The number of the order whose cameras explain clearly more of what pictures share; None where none does.

    Args:
        orders: The same pictures with the same cameras, laid beside each other in several ways.
    """
    cameras = [{frame.path: frame.camera for frame in frames} for frames in orders]
    pairs = {pair for frames in orders for pair in _neighbours(frames)}
    found: dict[Path, tuple[np.ndarray, np.ndarray]] = {}
    explained = np.zeros(len(orders))
    for one, other in sorted(pairs):
        for path in (one, other):
            if path not in found:
                found[path] = _features(path)
        a, b = _matches(*found[one], *found[other])
        for n, of in enumerate(cameras):
            explained[n] += _on_lines(of[one], of[other], a, b)
    best, *others = np.argsort(-explained).tolist()
    clear = all(explained[best] > CLEARLY * explained[n] for n in others)
    return best if explained[best] >= FEWEST and clear else None


def _neighbours(frames: Sequence[PosedFrame]) -> list[tuple[Path, Path]]:
    centres = np.array([frame.camera.centre for frame in frames])
    out = []
    for n in spread(range(len(frames)), PAIRS):
        away = np.linalg.norm(centres - centres[n], axis=1)
        away[n] = np.inf
        one, other = sorted((frames[n].path, frames[int(away.argmin())].path))
        out.append((one, other))
    return out


def _features(path: Path) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 128"]]:
    """Places in pixels of the whole picture, and descriptors."""
    import cv2  # only sets whose orders differ need it

    picture = read_pixels(path)
    scale = min(1.0, SIDE / max(picture.shape[:2]))
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT.create(FEATURES, contrastThreshold=CONTRAST).detectAndCompute(small, None)
    if descriptors is None:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    return (np.array([point.pt for point in points]) + 0.5) / scale, descriptors.astype(np.float32)


def _matches(
    a: np.ndarray, of_a: np.ndarray, b: np.ndarray, of_b: np.ndarray
) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, "m 2"]]:
    import cv2

    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    near = cv2.BFMatcher().knnMatch(of_a, of_b, k=2)
    good = [first for first, second in near if first.distance < RATIO * second.distance]
    return a[[m.queryIdx for m in good]].reshape(-1, 2), b[[m.trainIdx for m in good]].reshape(-1, 2)


def _on_lines(one: Camera, other: Camera, a: Float[np.ndarray, "m 2"], b: Float[np.ndarray, "m 2"]) -> int:
    """How many matches lie near the epipolar lines of two cameras without distortion."""
    from_one = other.cam_from_world[:, :3] @ one.cam_from_world[:, :3].T
    shift = other.cam_from_world[:, 3] - from_one @ one.cam_from_world[:, 3]
    x, y, z = shift
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ from_one
    fundamental = np.linalg.inv(other.K).T @ essential @ np.linalg.inv(one.K)
    a, b = (np.column_stack([points, np.ones(len(points))]) for points in (a, b))
    lines = a @ fundamental.T
    away = np.abs((lines * b).sum(1)) / np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    return int((away < NEAR * max(other.width, other.height)).sum()) if np.linalg.norm(shift) > 0 else 0
