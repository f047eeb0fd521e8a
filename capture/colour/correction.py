"""The look of a picture: what brings its colours to those of the reference camera, in linear light.

    linear_out = matrix · (gains * linear_in),   linear_in = the sRGB curve undone

`gains` are this picture's own (steady light), `matrix` is the camera's.
Pictures on disk keep their colours: a look is applied when a picture is loaded, and leaving it away takes it back. A
value that is clipped in the source says "at least so bright"; after the correction it still stands for its clip level
and nothing more. Values that leave [0, 1] are clipped.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.colour.srgb import LEVEL_OF_LINEAR, LINEAR_OF_LEVEL

Matrix = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
Gains = tuple[float, float, float]

SAME: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
EVEN: Gains = (1.0, 1.0, 1.0)
ROWS = 64  # corrected at once: a strip of a 1080p picture stays in the processor's cache


@dataclass(frozen=True)
class Look:
    """The correction of one picture.

    Attributes:
        matrix: Of the camera; rows are R, G, B of the reference.
        gains: Of this picture: R, G, B.
    """

    matrix: Matrix = SAME
    gains: Gains = EVEN

    def __post_init__(self) -> None:
        numbers = np.array([*self.matrix, self.gains])
        if not np.isfinite(numbers).all() or not min(self.gains) > 0:
            text = f"look {self.matrix}, gains {self.gains}: expected finite numbers, gains above 0"
            raise ValueError(text)
        if not abs(np.linalg.det(numbers[:3])) > 1e-6:
            raise ValueError(f"look {self.matrix} loses colours: its determinant is 0")

    @property
    def changes(self) -> bool:
        """Whether it does anything."""
        return self != Look()

    def apply(self, rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The picture as the reference camera would show it, sRGB."""
        matrix = np.array(self.matrix, np.float64)
        if np.array_equal(matrix, np.diag(np.diag(matrix))):
            factors = np.diag(matrix) * self.gains
            tables = [_levels(np.float32(f) * LINEAR_OF_LEVEL) for f in factors]
            return np.stack([table[rgb[..., c]] for c, table in enumerate(tables)], axis=-1)
        mixing = (matrix * self.gains).astype(np.float32).T
        out = np.empty_like(rgb)
        for top in range(0, len(rgb), ROWS):
            out[top : top + ROWS] = _levels(LINEAR_OF_LEVEL[rgb[top : top + ROWS]] @ mixing)
        return out


def as_matrix(values: Float[np.ndarray, "3 3"]) -> Matrix:
    """An array as the plain numbers that a look holds."""
    return tuple(tuple(float(v) for v in row) for row in values)  # pyright: ignore[reportReturnType]: 3 x 3


def as_gains(values: Float[np.ndarray, "3"]) -> Gains:
    """An array as the plain numbers that a look holds."""
    return (float(values[0]), float(values[1]), float(values[2]))


def _levels(linear: Float[np.ndarray, "*batch"]) -> UInt8[np.ndarray, "*batch"]:
    """Linear light as 8-bit sRGB."""
    steps = np.clip(linear, 0, 1) * np.float32(65535) + np.float32(0.5)
    return LEVEL_OF_LINEAR[steps.astype(np.uint16)]
