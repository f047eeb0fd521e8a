"""Mattes of a fixed camera's clip by its clean plate: the scene without what moves in it.

The plate is the median of pictures spread over the clip. A picture, brought to the plate's exposure, differs
from it in multiples of the noise. A shadow is darker by one smooth factor and has the plate's colours
(Horprasert, Harwood, Davis, ICCV FRAME-RATE 1999). What certainly differs and what certainly does not start a
graph cut (GrabCut, Rother, Kolmogorov, Blake, SIGGRAPH 2004) on the picture of differences, in which the
background's own edges have vanished. All of this at a bounded size, so memory does not grow with the clip.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from devrf.capture.mattes.tidy import eroded, soft, tidy
from devrf.capture.picture_files import read_pixels

PLATE_FRAMES = 25  # odd; at most this many pictures are held at once, at the working size
WORK_SIDE_PX = 720  # of the longer side; a graph cut of it takes half a second
LEAST_NOISE = 1.5  # grey levels; compression and rounding leave no less
SURE, MAYBE = 8.0, 3.5  # multiples of the noise: subject; and where the cut decides
DARKEST_SHADOW = 0.4  # of the light; what is darker is taken for the subject
SHADOW_COLOUR = 3.0  # multiples of the noise a shadow's colour may be off
# Standard deviation of the logarithm of a shadow's factor within a few pixels, beyond noise.
SHADOW_ROUGH = 0.06
ITERATIONS = 2
UNSTEADY = 3.0  # multiples of the noise between the quartiles: no one colour lasts half of the clip
SAME = 3.0  # multiples of the noise: the same colour


@dataclass(frozen=True)
class CleanPlate:
    """A fixed camera's picture without what moves, at the working size.

    Attributes:
        rgb: The picture.
        noise: Standard deviation of a channel, grey levels.
        unsteady: Where no colour lasts for half of the clip; the plate may show the subject.
    """

    rgb: Float32[np.ndarray, "h w 3"]
    noise: Float32[np.ndarray, "h w"]
    unsteady: Bool[np.ndarray, "h w"]


def clean_plate(files: Sequence[Path]) -> CleanPlate:
    """The median of pictures spread over a clip, and the noise about it."""
    chosen = np.unique(np.linspace(0, len(files) - 1, PLATE_FRAMES).round().astype(int))
    stack = np.stack([_small(read_pixels(files[n])) for n in chosen])
    median = np.median(stack, axis=0).astype(np.float32)
    for n, picture in enumerate(stack):  # brought to one exposure, then once more
        stack[n] = np.clip(picture * exposure(picture, median), 0, 255).round()
    low, median, high = (p.astype(np.float32) for p in np.percentile(stack, [25, 50, 75], axis=0))
    away = np.median(np.abs(stack.astype(np.float32) - median), axis=0).max(axis=-1)
    noise = cv2.GaussianBlur(1.4826 * away.astype(np.float32), (0, 0), 3)
    usual = max(LEAST_NOISE, float(np.median(noise)))
    noise = np.clip(noise, LEAST_NOISE, 2 * usual)  # what moves is no noise
    unsteady = (high - low).max(axis=-1) > UNSTEADY * noise
    median[unsteady] = _most_lasting(stack[:, unsteady], noise[unsteady])
    opened = cv2.morphologyEx(unsteady.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return CleanPlate(median, noise, opened.astype(bool))


def _most_lasting(
    stack: UInt8[np.ndarray, "k n 3"], noise: Float32[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 3"]:
    """The colour that most pictures are near to.

    Where the subject hides the background for most of the clip the median is the subject's; the background is
    still the one colour that comes back.
    """
    best = np.zeros(stack.shape[1], np.int32)
    colour = np.zeros(stack.shape[1:], np.float32)
    for picture in stack:
        near = np.abs(stack.astype(np.int16) - picture).max(axis=-1) < SAME * noise
        count = near.sum(axis=0)
        better = count > best
        best[better] = count[better]
        mean = (stack[:, better] * near[:, better, None]).sum(axis=0) / count[better, None]
        colour[better] = mean
    return colour


def plate_matte(picture: UInt8[np.ndarray, "h w 3"], plate: CleanPlate) -> UInt8[np.ndarray, "h w"]:
    """Where a picture of the camera shows something else than the plate; 255 is the subject."""
    small = _small(picture).astype(np.float32)
    small = small * exposure(small, plate.rgb)
    mask = _cut(*_evidence(small, plate))
    return soft(eroded(tidy(mask)), picture.shape[1], picture.shape[0])


def exposure(picture: np.ndarray, plate: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "3"]:
    """Factor per channel that brings a picture to the plate's exposure: the median over well exposed pixels."""
    usable = ((plate > 16) & (plate < 240)).all(axis=-1)
    if not usable.any():
        return np.ones(3, np.float32)
    ratio = plate[usable] / np.maximum(picture[usable].astype(np.float32), 1.0)
    return np.median(ratio, axis=0).astype(np.float32)


def _evidence(
    picture: Float32[np.ndarray, "h w 3"], plate: CleanPlate
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Differences as a picture of 8 bits, 16 levels per multiple of the noise; and where a cut starts from."""
    noise = plate.noise[..., None]
    difference = cv2.GaussianBlur((picture - plate.rgb) / noise, (0, 0), 1.0)  # lowers noise to 0.28 of it
    shadow = _shadow(picture, plate)
    apart = np.abs(difference).max(axis=-1)
    apart[shadow] = np.minimum(apart[shadow], MAYBE)
    start = np.full(apart.shape, cv2.GC_PR_BGD, np.uint8)
    start[apart > MAYBE] = cv2.GC_PR_FGD
    near = cv2.dilate((apart > MAYBE).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    start[~near] = cv2.GC_BGD
    start[eroded(apart > SURE)] = cv2.GC_FGD
    shown = difference.copy()
    shown[shadow] *= MAYBE / np.maximum(np.abs(difference[shadow]).max(axis=-1, keepdims=True), MAYBE)
    return np.clip(128 + 4 * shown, 0, 255).astype(np.uint8), start


def _shadow(picture: Float32[np.ndarray, "h w 3"], plate: CleanPlate) -> Bool[np.ndarray, "h w"]:
    """Where the plate is seen, darker by a factor that is smooth."""
    blurred = cv2.GaussianBlur(picture, (0, 0), 1.0)
    behind = cv2.GaussianBlur(plate.rgb, (0, 0), 1.0)
    factor = (blurred * behind).sum(-1) / np.maximum((behind**2).sum(-1), 1.0)
    colour = np.abs(blurred - factor[..., None] * behind).max(axis=-1) / plate.noise
    level = np.log(np.clip(factor, 0.05, 20))
    mean = cv2.blur(level, (7, 7))
    rough = np.sqrt(np.maximum(cv2.blur(level**2, (7, 7)) - mean**2, 0))
    noise = plate.noise / np.maximum(behind.mean(-1), 8.0)  # of the factor's logarithm
    return (
        (factor > DARKEST_SHADOW) & (factor < 1.0) & (colour < SHADOW_COLOUR) & (rough < SHADOW_ROUGH + noise)
    )


def _cut(difference: UInt8[np.ndarray, "h w 3"], start: UInt8[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """A graph cut that keeps what is sure."""
    if not (start == cv2.GC_FGD).any() or not (start == cv2.GC_BGD).any():
        return start == cv2.GC_FGD
    labels = start.copy()
    cv2.setRNGSeed(0)  # its colour models begin with random clusters
    cv2.grabCut(
        difference,
        labels,
        (0, 0, 1, 1),
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        ITERATIONS,
        cv2.GC_INIT_WITH_MASK,
    )
    return (labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)


def _small(picture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "small_h small_w 3"]:
    """At the working size."""
    height, width = picture.shape[:2]
    scale = min(1.0, WORK_SIDE_PX / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return cv2.resize(np.ascontiguousarray(picture[..., :3]), size, interpolation=cv2.INTER_AREA)
