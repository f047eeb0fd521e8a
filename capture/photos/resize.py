"""Shrinking pictures by area, and other filters that act on rows and columns alike.

A filter along one side of a picture is a sparse matrix [new, old]; both sides together are two products.
"""

import numpy as np
from jaxtyping import Shaped
from scipy.sparse import csr_array


def shrink(picture: Shaped[np.ndarray, "_ _ *c"], width: int, height: int) -> Shaped[np.ndarray, "_ _ *c"]:
    """Each new pixel is the mean over the area that it covers (what OpenCV calls INTER_AREA).

    Args:
        picture: 8-bit, or single precision.
        width, height: New size, at most the old one.
    Returns:
        The picture [height, width, ...], of the same type; 8-bit values are rounded.
    """
    old_height, old_width = picture.shape[:2]
    if not (1 <= width <= old_width and 1 <= height <= old_height):
        raise ValueError(f"cannot shrink {old_width}x{old_height} to {width}x{height}")
    if (width, height) == (old_width, old_height):
        return picture.copy()
    rows, columns = area_weights(old_height, height), area_weights(old_width, width)
    out = filter_sides(picture.astype(np.float32), rows, columns)
    return (out + 0.5).astype(np.uint8) if picture.dtype == np.uint8 else out


def area_weights(old: int, new: int) -> csr_array:
    """Share of each old pixel in each new one [new, old]; rows add up to 1."""
    scale = old / new
    low = np.arange(new)[:, None] * scale
    reach = int(np.ceil(scale)) + 1
    pixel = np.floor(low).astype(np.int64) + np.arange(reach)
    share = np.clip(np.minimum(low + scale, pixel + 1) - np.maximum(low, pixel), 0, None)
    share[pixel >= old] = 0
    return _matrix(share / share.sum(axis=1, keepdims=True), np.minimum(pixel, old - 1), old, np.float32)


def window_weights(taps: np.ndarray, old: int) -> csr_array:
    """A window [taps] at every place where it lies inside [old - taps + 1, old]."""
    new = old - len(taps) + 1
    pixel = np.arange(new)[:, None] + np.arange(len(taps))
    return _matrix(np.broadcast_to(taps, pixel.shape), pixel, old, taps.dtype)


def filter_sides(
    picture: Shaped[np.ndarray, "_ _ *c"], rows: csr_array, columns: csr_array
) -> Shaped[np.ndarray, "_ _ *c"]:
    """Apply `rows` [new_height, height] down the picture and `columns` [new_width, width] across it."""
    height, width, *channels = picture.shape
    tall = (rows @ picture.reshape(height, -1)).reshape(-1, width, *channels).swapaxes(0, 1)
    wide = columns @ np.ascontiguousarray(tall).reshape(width, -1)
    return np.ascontiguousarray(wide.reshape(-1, tall.shape[1], *channels).swapaxes(0, 1))


def _matrix(weights: np.ndarray, pixel: np.ndarray, old: int, dtype: type | np.dtype) -> csr_array:
    starts = np.arange(len(pixel) + 1) * pixel.shape[1]
    data = np.ascontiguousarray(weights, dtype).ravel()
    return csr_array((data, pixel.ravel(), starts), shape=(len(pixel), old))
