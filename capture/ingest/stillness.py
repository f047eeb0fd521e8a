"""How much of a fixed camera's picture moves, told from a few pictures."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.capture.frames import grey_small

SIDE_PX = 480  # of the pictures that are compared
SMOOTH_PX = 2.0  # averages sensor noise and the grain of compression to a fraction of a level
AT_REST = 0.005  # of the picture: more changes from picture to picture where something moves
CHANGED_LEVELS = 3.0  # of smoothed pictures: pictures of a scene at rest stay below a level


def smooth_grey(rgb: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "h w"]:
    """What is compared: small, grey, smoothed, levels of 255."""
    return cv2.GaussianBlur(grey_small(rgb, SIDE_PX).astype(np.float32), (0, 0), SMOOTH_PX)


def changed(first: Float[np.ndarray, "h w"], second: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Where two smoothed pictures differ by more than noise; a change of the whole picture's level does not count."""
    difference = second - first
    return np.abs(difference - np.median(difference)) > CHANGED_LEVELS


def moving_share(run: Sequence[Float[np.ndarray, "h w"]]) -> float | None:
    """Largest share of the picture that changes between two successive smoothed pictures; None for less than two."""
    shares = [float(changed(a, b).mean()) for a, b in zip(run, run[1:], strict=False)]
    return max(shares) if shares else None


def moving_mask(pictures: Sequence[Float[np.ndarray, "h w"]]) -> Bool[np.ndarray, "h w"]:
    """Where pictures spread over a clip leave their median: what moves in it."""
    middle = np.median(np.stack(pictures), axis=0)
    return np.any([changed(middle, picture) for picture in pictures], axis=0)
