"""From levels in other primaries and by another curve to sRGB (IEC 61966-2-1): one rule for photos and clips.

Primaries are numbered as in ITU-T H.273, Table 2. What is outside of sRGB is clipped, colour by colour.
"""

from functools import cache

import numpy as np
from jaxtyping import Float, Float32, UInt8

from devrf.capture.colour.srgb import LEVEL_OF_LINEAR

SRGB, BT2020, DCI_P3, DISPLAY_P3, ADOBE_RGB = 1, 9, 11, 12, 256  # the last one is no number of H.273
D65 = (0.3127, 0.3290)
CHROMATICITIES = {  # x and y of red, green, blue and white
    SRGB: ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65),
    BT2020: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65),
    DCI_P3: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), (0.314, 0.351)),
    DISPLAY_P3: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65),
    ADOBE_RGB: ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65),
}
NAMES = {SRGB: "sRGB", BT2020: "BT.2020", DCI_P3: "DCI P3", DISPLAY_P3: "Display P3", ADOBE_RGB: "Adobe RGB"}
STRIPE_ROWS = 64  # converted at once, so that what is in between stays in the cache


def srgb_of(
    levels: UInt8[np.ndarray, "height width channels"],
    light: Float32[np.ndarray, "256 3"],
    srgb_from_own: Float32[np.ndarray, "3 3"],
) -> UInt8[np.ndarray, "height width channels"]:
    """A picture in sRGB; what it has beside red, green and blue stays.

    Args:
        levels: As stored.
        light: Linear light in [0, 1] of each level of red, green and blue.
        srgb_from_own: Takes linear light in the picture's primaries to sRGB's.
    """
    out = levels.copy()
    for top in range(0, len(levels), STRIPE_ROWS):
        part = levels[top : top + STRIPE_ROWS, :, :3]
        linear = np.clip(light[part, np.arange(3)] @ srgb_from_own.T, 0, 1)
        out[top : top + STRIPE_ROWS, :, :3] = LEVEL_OF_LINEAR[(linear * 65535 + 0.5).astype(np.uint16)]
    return out


@cache
def srgb_from_primaries(number: int) -> Float32[np.ndarray, "3 3"]:
    """Takes linear light in one of `CHROMATICITIES` to sRGB's primaries."""
    return srgb_from_chromaticities(np.array(CHROMATICITIES[number]))


def srgb_from_chromaticities(xy: Float[np.ndarray, "4 2"]) -> Float32[np.ndarray, "3 3"]:
    """Takes linear light in these primaries (red, green, blue and white) to sRGB's, white to white.

    Raises:
        ValueError, numpy.linalg.LinAlgError: They are no primaries.
    """
    with np.errstate(all="ignore"):
        return white_to_white(np.linalg.solve(_xyz(np.array(CHROMATICITIES[SRGB])), _xyz(xy)))


def white_to_white(matrix: Float[np.ndarray, "3 3"]) -> Float32[np.ndarray, "3 3"]:
    """The matrix with its rows scaled so that greys stay grey.

    Raises:
        ValueError: It makes no light of white.
    """
    white = matrix.sum(axis=1, keepdims=True)
    if not (np.isfinite(matrix).all() and white.min() > 1e-3):
        raise ValueError(f"no primaries: white becomes {white.ravel().tolist()}")
    return (matrix / white).astype(np.float32)


def _xyz(xy: Float[np.ndarray, "4 2"]) -> Float[np.ndarray, "3 3"]:
    """CIE XYZ of one unit of each primary, where white has Y = 1."""
    x, y = xy.T
    red, green, blue, white = np.stack([x / y, np.ones(4), (1 - x - y) / y], axis=1)
    columns = np.stack([red, green, blue], axis=1)
    return columns * np.linalg.solve(columns, white)
