"""Pictures of any size for methods that need sides of a least length, or multiples of a number."""

import numpy as np
from jaxtyping import Float32, UInt8


def pad(
    image: UInt8[np.ndarray, "height width 3"], least: int, multiple: int
) -> UInt8[np.ndarray, "padded_height padded_width 3"]:
    """The picture with its border repeated on all sides alike, to sides of at least `least` and a `multiple`."""
    around = [_around(side, least, multiple) for side in image.shape[:2]]
    return np.pad(image, [*around, (0, 0)], mode="edge")


def crop(
    flow: Float32[np.ndarray, "padded_height padded_width 2"], height: int, width: int
) -> Float32[np.ndarray, "height width 2"]:
    """What belongs to the picture before it was padded."""
    top, left = (flow.shape[0] - height) // 2, (flow.shape[1] - width) // 2
    return flow[top : top + height, left : left + width]


def _around(side: int, least: int, multiple: int) -> tuple[int, int]:
    new = -(-max(side, least) // multiple) * multiple
    return (new - side) // 2, new - side - (new - side) // 2
