"""Mattes by a key colour: a green or blue screen behind the subject.

In YCbCr a screen's pixels lie along one direction of chroma, as far out as they are lit. A pixel's *key* is how far
its chroma reaches along that direction, less how far it lies beside it (Jack, Video Demystified, 5th ed., chroma
keying; the sector is 90 degrees wide), over its luma: shade changes it little. Transparent where the key is near the
screen's, opaque where it is small, in between at edges, which mix both.
"""

import colorsys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from devrf.capture.mattes.tidy import tidy
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.system.errors import HealthError, InputError
from devrf.capture.system.spread import spread

PICTURES = 12  # looked at for the key colour
SIDE_PX = 200
LEAST_CHROMA = 18.0  # of the screen, 8-bit levels; less is a grey wall
LEAST_SHARE = 0.15  # of the pictures: a screen behind the subject shows at least so much
BINS, BIN_DEG = 72, 5.0
SECTOR_DEG = 15.0  # to either side of the commonest direction; screens vary by a few degrees
DARK = 20.0  # levels of luma: chroma of darker pixels is noise
# Paints and cloths made for screens lie at 120 to 142 (green) and 217 to 226 (blue) degrees of hue, as sRGB; the limits
# leave room for warm and cold light and a wrong white balance. Skin, wood, and yellow to red cloths stay below 60.
SCREEN_HUES_DEG = (80.0, 165.0), (195.0, 255.0)
CLEAR, OPAQUE = 0.6, 0.2  # of the screen's key: at least so much is screen, at most so much is subject


def find_key(camera: str, files: Sequence[Path]) -> Float[np.ndarray, "3"]:
    """The key colour of a camera's pictures, RGB in 0 to 255: the commonest strong direction of chroma.

    Raises:
        HealthError: There is none.
    """
    rgb = np.concatenate([_few_pixels(file) for file in spread(files, PICTURES)]).astype(np.float32)
    luma, chroma = _ycc(rgb)
    strength = np.hypot(*chroma.T)
    strong = (strength > LEAST_CHROMA) & (luma > DARK)
    angle = np.degrees(np.arctan2(chroma[:, 1], chroma[:, 0])) % 360
    histogram = np.bincount((angle[strong] // BIN_DEG).astype(int), minlength=BINS)
    best = BIN_DEG * (int(histogram.argmax()) + 0.5)
    near = strong & (np.abs((angle - best + 180) % 360 - 180) < SECTOR_DEG)
    if near.mean() < LEAST_SHARE:
        wrong = f"camera '{camera}': no key colour found"
        fills = f"the commonest strong colour fills {100 * near.mean():.0f} % of its pictures"
        expected = f"expected at least {100 * LEAST_SHARE:.0f} %; light the screen evenly"
        remedy = (
            "name its colour (capture.mattes: {method: chroma, colour: '#00b140'}), or use another method"
        )
        raise HealthError("key-colour-unfound", f"{wrong}: {fills}, {expected}, {remedy}")
    return np.median(rgb[near], axis=0)


def is_screen_hue(rgb: Float[np.ndarray, "3"]) -> bool:
    """Whether a colour, RGB in 0 to 255, can be that of a green or blue screen."""
    hue_deg = 360 * colorsys.rgb_to_hsv(*(float(value) / 255 for value in rgb))[0]
    return any(least <= hue_deg <= most for least, most in SCREEN_HUES_DEG)


def chroma_matte(
    picture: UInt8[np.ndarray, "h w c"], key_rgb: Float[np.ndarray, "3"]
) -> UInt8[np.ndarray, "h w"]:
    """Opacity of a picture before a screen of this colour, 255 is the subject."""
    share = key_share(picture, key_rgb)
    opacity = np.clip((CLEAR - share) / (CLEAR - OPAQUE), 0, 1)
    shown = opacity > 0.5
    tidied = tidy(shown)
    opacity[tidied & ~shown] = 1
    edge = cv2.dilate(tidied.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    opacity[~edge] = 0
    return (255 * opacity).round().astype(np.uint8)


def key_share(
    picture: UInt8[np.ndarray, "h w c"], key_rgb: Float[np.ndarray, "3"]
) -> Float32[np.ndarray, "h w"]:
    """How much of the key colour each pixel has: 1 on the screen, 0 or less on other colours."""
    luma, chroma = _ycc(
        cv2.GaussianBlur(np.ascontiguousarray(picture[..., :3]), (0, 0), 0.8).astype(np.float32)
    )
    (key_luma,), (key_chroma,) = _ycc(key_rgb.astype(np.float32)[None])
    length = float(np.hypot(*key_chroma))
    along = chroma @ (key_chroma / length)
    beside = np.abs(chroma @ (np.array([-key_chroma[1], key_chroma[0]], np.float32) / length))
    return (along - beside) / np.maximum(luma, DARK) / (length / float(key_luma))


def parse_colour(text: str) -> Float[np.ndarray, "3"]:
    """RGB in 0 to 255 of `#rrggbb`.

    Raises:
        InputError: A grey, which has no chroma to tell the screen by.
    """
    rgb = np.array([int(text[n : n + 2], 16) for n in (1, 3, 5)], np.float64)
    chroma = float(np.hypot(*_ycc(rgb.astype(np.float32)[None])[1][0]))
    if chroma < LEAST_CHROMA:
        wrong = f"{text} is nearly grey (chroma {chroma:.0f} of 255)"
        expected = f"expected a strong colour (at least {LEAST_CHROMA:.0f})"
        remedy = "a grey screen cannot be told from shadow and cloth; use another method"
        raise InputError("key-colour-grey", f"{wrong}, {expected}: {remedy}")
    return rgb


def _ycc(rgb: Float32[np.ndarray, "*n 3"]) -> tuple[Float32[np.ndarray, "*n"], Float32[np.ndarray, "*n 2"]]:
    """Luma, and Cb and Cr (ITU-R BT.601)."""
    luma = rgb @ np.array([0.299, 0.587, 0.114], np.float32)
    return luma, np.stack([0.564 * (rgb[..., 2] - luma), 0.713 * (rgb[..., 0] - luma)], axis=-1)


def _few_pixels(file: Path) -> UInt8[np.ndarray, "n 3"]:
    picture = read_pixels(file)[..., :3]
    scale = min(1.0, SIDE_PX / max(picture.shape[:2]))
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return cv2.resize(np.ascontiguousarray(picture), size, interpolation=cv2.INTER_AREA).reshape(-1, 3)
