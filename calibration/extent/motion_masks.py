"""Where a fixed camera sees something move: its pictures over time, small.

What hardly moves counts where it hangs on what moves much: the foot of a swinging arm, the hinge of a door. Shadows and
light change brightness, but not the pattern of what they fall on; what moves changes both.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from scipy import ndimage

from devrf.capture.camera import Camera

MASK_SIDE_PX = 200
MASK_FRAMES = 48  # of a clip
NOISE = 5.0  # a pixel moves if its range over time exceeds this multiple of the median pixel's
FAINT_NOISE = 2.5  # where it hangs on pixels that move: 2 takes in shadows and light, too
FLOOR = 10.0  # grey levels
CEILING = 40.0  # more is no noise: the subject fills half the picture, and the median pixel moves too
LONE = 1  # pictures of each clip, darkest and brightest, that say nothing: flashes, damaged ones ...
MANY = 8  # ... where there are so many: of four pictures, what moves is the brightest or the darkest in one
# The pattern: the logarithm of brightness over that around, by a Gaussian of so many pixels. In six captures it changes
# by 0.23 to 0.42 where things move, by 0.02 in shadows, by 0.01 to 0.08 elsewhere.
AROUND_PX, PATTERN_NOISE, PATTERN_FLOOR, PATTERN_CEILING = 3.0, 2.5, 0.1, 0.2
DARK = 10.0  # grey levels that are added before the logarithm


@dataclass(frozen=True)
class MotionMask:
    """Where a fixed camera saw something change.

    Attributes:
        camera: At the mask's size.
        mask: Pixels that change.
        much: Those that change by much, and a little around; None: all of the mask.
        pattern: Where more than brightness changes; None: in all of the mask.
    """

    camera: Camera
    mask: Bool[np.ndarray, "h w"]
    much: Bool[np.ndarray, "h w"] | None = None
    pattern: Bool[np.ndarray, "h w"] | None = None

    @property
    def moved(self) -> Bool[np.ndarray, "h w"]:
        """Pixels that change by more than light and shadow."""
        return self.mask if self.pattern is None else self.mask & self.pattern


def motion_mask(camera: Camera, pictures: Sequence[UInt8[np.ndarray, "h w"]]) -> MotionMask:
    """What changes over time in grey pictures of a fixed camera.

    Each picture is brought to the median brightness first, so that exposure changes do not count.

    Args:
        camera: At the size of the pictures.
        pictures: In any order.
    """
    stack = np.stack(pictures).astype(np.float32)
    level = np.median(stack, axis=(1, 2), keepdims=True)
    stack *= np.median(level) / np.maximum(level, 1.0)
    spread = _spread(stack)
    noise = float(np.median(spread))
    much, faint = (_opened(spread > np.clip(n * noise, FLOOR, CEILING)) for n in (NOISE, FAINT_NOISE))
    pieces = np.empty(spread.shape, dtype=np.int32)
    ndimage.label(faint, structure=np.ones((3, 3)), output=pieces)
    hangs = (pieces > 0) & np.isin(pieces, pieces[much])
    return MotionMask(camera, _grown(hangs), _grown(much), _grown(_opened(_pattern_changes(stack))))


def _pattern_changes(stack: Float32[np.ndarray, "n h w"]) -> Bool[np.ndarray, "h w"]:
    pattern = np.log(stack + DARK)
    pattern -= ndimage.gaussian_filter(pattern, (0, AROUND_PX, AROUND_PX))
    spread = _spread(pattern)
    noise = PATTERN_NOISE * float(np.median(spread))
    return spread > np.clip(noise, PATTERN_FLOOR, PATTERN_CEILING)


def _spread(stack: Float32[np.ndarray, "n h w"]) -> Float32[np.ndarray, "h w"]:
    """Range over time, without the lone extremes."""
    lone = LONE if len(stack) >= MANY else 0
    ordered = np.sort(stack, axis=0)
    return ordered[-1 - lone] - ordered[lone]


def _opened(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    kernel = np.ones((3, 3), dtype=np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel).astype(bool)


def _grown(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without small gaps, and a little around."""
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((7, 7), dtype=np.uint8))
    return cv2.dilate(closed, np.ones((5, 5), dtype=np.uint8)).astype(bool)
