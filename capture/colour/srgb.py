"""The sRGB curve (IEC 61966-2-1): from linear light in [0, 1] to what pictures store, and back."""

import numpy as np
from jaxtyping import Float, UInt8

LINEAR_END = 0.0031308  # below it the curve is a straight line


def srgb_from_linear(linear: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """The sRGB curve, values in [0, 1]."""
    curve = 1.055 * np.power(np.maximum(linear, LINEAR_END), 1 / 2.4) - 0.055
    return np.where(linear <= LINEAR_END, 12.92 * linear, curve).astype(linear.dtype)


def linear_from_srgb(values: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """Inverse of `srgb_from_linear`."""
    curve = np.power((np.maximum(values, 0) + 0.055) / 1.055, 2.4)
    return np.where(values <= 12.92 * LINEAR_END, values / 12.92, curve).astype(values.dtype)


LINEAR_OF_LEVEL: Float[np.ndarray, " 256"] = linear_from_srgb(np.arange(256) / 255).astype(np.float32)
"""Linear light of each of the 256 levels of an 8-bit picture."""

LEVEL_OF_LINEAR: UInt8[np.ndarray, " 65536"] = np.round(
    255 * srgb_from_linear(np.arange(65536) / 65535)
).astype(np.uint8)
"""The 8-bit level of linear light in 16 bits: a step is 0.05 levels where the curve is steepest."""
