"""Light fall-off towards the corners of a fixed camera, from pictures of a white sheet.

The fall-off is even around the picture's centre: log2 V = a r² + b r⁴ + c r⁶, r = 1 in the corners. The sheet itself
may be lit from one side: a plane in log light takes that, and is not part of the result.
"""

import numpy as np
from jaxtyping import Float

from devrf.capture.errors import CalibrationError

GRID = (18, 32)  # rows, columns of the map; the fall-off is smooth, between them it is interpolated
SMOOTH_STOPS = 0.06  # 4 % of the light: a sheet's texture and noise, averaged over cells, stay below
UNEVEN_SHARE = 0.1  # of the cells
ITERATIONS = 10  # of reweighting; from half of it on the map moves by less than 1e-4


def flat_field(
    white: Float[np.ndarray, "rows columns 3"], name: str = "white sheet"
) -> Float[np.ndarray, "18 32"]:
    """Relative light over the picture, from the mean picture of a white sheet.

    Args:
        white: Mean of the sheet's pictures, linear light [rows, columns, 3], any size (`capture.white.mean_white`).
        name: What it is called in a message.
    Returns:
        Map [18, 32] in (0, 1]: values at the centres of equal cells that cover the picture; 1 where it is brightest.
        Pictures in linear light are divided by it.
    Raises:
        CalibrationError: If the sheet is not smooth: something else is in the picture.
    """
    values = np.log2(np.maximum(white.mean(axis=-1), 1e-6)).ravel()
    rows, columns = white.shape[:2]
    x, y = _centres(rows, columns, columns / rows)
    design = np.column_stack([np.ones(rows * columns), x, y, _powers(x, y, columns / rows)])
    fitted = np.linalg.lstsq(design, values, rcond=None)[0]
    left = np.abs(values - design @ fitted)
    for _ in range(ITERATIONS):  # of reweighted least squares, Huber's weights: dirt and edges count less
        scale = max(SMOOTH_STOPS / 4, 1.4826 * float(np.median(left)))
        root = np.sqrt(np.minimum(1, 1.345 * scale / np.maximum(left, 1e-9)))
        fitted = np.linalg.lstsq(design * root[:, None], values * root, rcond=None)[0]
        left = np.abs(values - design @ fitted)
    uneven = float(np.mean(left > SMOOTH_STOPS))
    if uneven > UNEVEN_SHARE:
        most, off = 100 * UNEVEN_SHARE, 100 * (2**SMOOTH_STOPS - 1)
        wrong = f"{name}: {100 * uneven:.0f} % of the picture is not an evenly lit sheet"
        fall_off = f"more than {off:.0f} % off a smooth fall-off"
        remedy = "fill the whole picture with a white sheet, out of focus, without shadows"
        text = f"{wrong} ({fall_off}), expected at most {most:.0f} %; {remedy}"
        raise CalibrationError("white-sheet-uneven", text)
    grid_x, grid_y = _centres(*GRID, columns / rows)
    stops = _powers(grid_x, grid_y, columns / rows) @ fitted[3:]
    return np.exp2(stops - stops.max()).reshape(GRID)


def _centres(
    rows: int, columns: int, aspect: float
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """Places of the cells' centres; the picture's centre is 0, its height 2, its width 2 `aspect`."""
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * aspect
    y = (np.arange(rows) + 0.5) / rows * 2 - 1
    grid_x, grid_y = np.meshgrid(x, y)
    return grid_x.ravel(), grid_y.ravel()


def _powers(
    x: Float[np.ndarray, " cells"], y: Float[np.ndarray, " cells"], aspect: float
) -> Float[np.ndarray, "cells 3"]:
    r2 = (x**2 + y**2) / (1 + aspect**2)
    return np.stack([r2, r2**2, r2**3], axis=-1)
