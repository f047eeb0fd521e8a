"""Did a fixed camera stay where it was? The background of its pictures over a clip.

Corners of the first picture are tracked into the others (pyramidal Lucas-Kanade, there and back). What most of them
agree on is the background; a similarity through these, by RANSAC, leaves out what moves. How far it carries the
picture's corners is how far the camera turned or slipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.spread import spread

PICTURES = 25  # of the clip that are looked at: a bump is found to a twenty-fifth of its length
FEATURES = 600
MIN_BACKGROUND = 30  # features that must agree
THERE_AND_BACK_PX = 0.3  # a track that does not return is none
BACKGROUND_PX = 1.0  # RANSAC
SIDE = 3  # pictures at each end, and on each side of a step, that are averaged by their median


@dataclass(frozen=True)
class Bump:
    """How a fixed camera's picture moved over its clip.

    Attributes:
        moved_px: The largest lasting movement of a picture's corner.
        at_s: When it happened, on the clock of the times given.
        background: Median number of features that agreed on the background.
    """

    moved_px: float
    at_s: float
    background: int


def find_bump(files: Sequence[Path], times_s: Sequence[float]) -> Bump | None:
    """Look for a lasting movement of the background.

    Args:
        files: Pictures of one fixed camera, in order; times_s: when they were taken.
    Returns:
        The largest movement, however small; None with too few pictures or too little background to tell.
    """
    chosen = spread(range(len(files)), PICTURES)
    if len(chosen) < 2 * SIDE:
        return None
    first = normalised(read_grey(files[chosen[0]]))
    start = background_features(first)
    if start is None:
        return None
    corners, counts, times = [np.zeros((4, 2))], [], [times_s[chosen[0]]]
    for n in chosen[1:]:
        found = background_motion(first, normalised(read_grey(files[n])), start)
        if found is not None:
            corners.append(found[0])
            counts.append(found[1])
            times.append(times_s[n])
    if len(corners) < max(2 * SIDE, len(chosen) // 2):
        return None
    moved_px, split = _largest_step(np.array(corners))
    return Bump(moved_px, float((times[split - 1] + times[split]) / 2), int(np.median(counts)))


def background_features(picture: UInt8[np.ndarray, "h w"]) -> Float32[np.ndarray, "n 1 2"] | None:
    """Features that can be followed into other pictures [n, 1, 2], pixels; None where there are too few."""
    found = cv2.goodFeaturesToTrack(picture, FEATURES, 0.01, 8)
    return None if found is None or len(found) < MIN_BACKGROUND else np.asarray(found, np.float32)


def background_motion(
    first: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 1 2"]
) -> tuple[Float[np.ndarray, "4 2"], int] | None:
    """How far a similarity from the first picture to another carries the picture's corners, pixels, and how many
    features agree on it; None where too few do.
    """
    there, ok, _ = cv2.calcOpticalFlowPyrLK(first, other, start, start.copy())
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(other, first, there, start.copy())
    good = (np.asarray(ok).reshape(-1) > 0) & (np.asarray(ok_back).reshape(-1) > 0)
    good &= np.linalg.norm((back - start).reshape(-1, 2), axis=1) < THERE_AND_BACK_PX
    if good.sum() < MIN_BACKGROUND:
        return None
    cv2.setRNGSeed(0)
    matrix, inliers = cv2.estimateAffinePartial2D(
        start[good], there[good], method=cv2.RANSAC, ransacReprojThreshold=BACKGROUND_PX
    )
    count = 0 if inliers is None else int(np.asarray(inliers).sum())
    if matrix is None or count < MIN_BACKGROUND:
        return None
    height, width = first.shape
    frame = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    similarity = np.asarray(matrix, dtype=np.float64)
    return frame @ similarity[:, :2].T + similarity[:, 2] - frame, count


def _largest_step(corners: Float[np.ndarray, "pictures 4 2"]) -> tuple[float, int]:
    """The split of the pictures in two whose medians differ most, in pixels of the corner that moved most."""
    splits = range(SIDE, len(corners) - SIDE + 1)
    left = np.array([_spread(corners[:s]) + _spread(corners[s:]) for s in splits])
    split = splits[int(left.argmin())]
    step = np.median(corners[split:], axis=0) - np.median(corners[:split], axis=0)
    ends = np.median(corners[-SIDE:], axis=0) - np.median(corners[:SIDE], axis=0)
    return float(max(np.linalg.norm(step, axis=1).max(), np.linalg.norm(ends, axis=1).max())), split


def _spread(corners: Float[np.ndarray, "pictures 4 2"]) -> float:
    return float(np.abs(corners - np.median(corners, axis=0)).sum())


def normalised(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Mean 128 and standard deviation 48, so that exposure that drifts does not move corners."""
    mean, std = float(grey.mean()), float(grey.std())
    return np.clip((grey - mean) * (48 / max(std, 1.0)) + 128, 0, 255).astype(np.uint8)
