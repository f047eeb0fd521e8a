"""The sRGB curve (IEC 61966-2-1): from linear light in [0, 1] to what pictures store, and back."""

import numpy as np
from jaxtyping import Float

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
