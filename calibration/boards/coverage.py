"""What the views of a board looked like, and what they leave open: where corners were, how the board was tilted."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.boards.board_fit import Fit

CELLS = 5  # along each side of the picture, as caliscope counts
TILTED_DEG = 15.0
SECTORS = 8  # of directions in which a board can be tilted
SAMPLE = 500  # residuals that are kept
PLACES = {  # name -> rows, columns of cells; an edge is what lies between two corners
    "top-left corner": ([0], [0]),
    "top-right corner": ([0], [CELLS - 1]),
    "bottom-left corner": ([CELLS - 1], [0]),
    "bottom-right corner": ([CELLS - 1], [CELLS - 1]),
    "top edge": ([0], range(1, CELLS - 1)),
    "bottom edge": ([CELLS - 1], range(1, CELLS - 1)),
    "left edge": (range(1, CELLS - 1), [0]),
    "right edge": (range(1, CELLS - 1), [CELLS - 1]),
}


@dataclass(frozen=True)
class BoardCoverage:
    """Of the views of one camera that were used.

    Attributes:
        frames: Of the views [V].
        cells: Corners in the picture's 5 x 5 cells, row by row from the top.
        tilt_deg: Of the board against the picture's plane [V]; towards_deg: where its normal leans in the
            picture [V], 0 right, 90 down.
        view_rms_px: [V].
        residuals: x, y, and projection minus observation there [n, 4], pixels; a sample.
    """

    frames: tuple[int, ...]
    cells: Int[np.ndarray, "5 5"]
    tilt_deg: Float[np.ndarray, " views"]
    towards_deg: Float[np.ndarray, " views"]
    view_rms_px: Float[np.ndarray, " views"]
    residuals: Float[np.ndarray, "n 4"]

    @property
    def coverage(self) -> float:
        """Share of cells with corners."""
        return float((self.cells > 0).mean())

    @property
    def unseen(self) -> list[str]:
        """Corners and edges of the picture in which no corner of the board was seen."""
        return [name for name, place in PLACES.items() if not self.cells[np.ix_(*place)].any()]

    @property
    def tilt_sectors(self) -> int:
        """In how many of eight directions the board was tilted."""
        tilted = self.towards_deg[self.tilt_deg >= TILTED_DEG]
        return len(np.unique((tilted % 360 // (360 / SECTORS)).astype(int)))

    def as_dict(self) -> dict[str, Any]:
        """For JSON; see docs/formats.md."""
        return {
            "frames": list(self.frames),
            "cells": self.cells.tolist(),
            "tilt_deg": self.tilt_deg.round(1).tolist(),
            "towards_deg": self.towards_deg.round(1).tolist(),
            "view_rms_px": self.view_rms_px.round(4).tolist(),
            "residuals": self.residuals.round(3).tolist(),
        }


def gather_evidence(fit: Fit, frames: list[int]) -> BoardCoverage:
    """Evidence of a fit whose views are of these frames."""
    normal = fit.poses[:, :, 2] * -np.sign(fit.poses[:, 2:, 2])  # the side that the camera sees
    count = len(fit.residual)
    chosen = np.random.default_rng(0).permutation(count)[:SAMPLE]
    chosen.sort()
    return BoardCoverage(
        frames=tuple(frames),
        cells=cell_counts(fit.corners.xy, fit.size),
        tilt_deg=np.degrees(np.arccos(np.clip(np.abs(normal[:, 2]), 0, 1))),
        towards_deg=np.degrees(np.arctan2(normal[:, 1], normal[:, 0])) % 360,
        view_rms_px=fit.view_rms_px,
        residuals=np.column_stack([fit.corners.xy, fit.residual])[chosen],
    )


def cell_counts(xy: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> Int[np.ndarray, "5 5"]:
    """Corners in each cell of the picture, row by row."""
    column, row = np.clip((xy / np.array(size) * CELLS).astype(int), 0, CELLS - 1).T
    return np.bincount(row * CELLS + column, minlength=CELLS**2).reshape(CELLS, CELLS)
