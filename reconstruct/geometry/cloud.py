"""A point cloud of the scene at a time, from the surfaces that its views show."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from devrf.reconstruct.geometry.seen import SeenView, agreed


@dataclass(frozen=True)
class Cloud:
    """Coloured points on surfaces.

    Attributes:
        xyz: Positions, in the box frame.
        normals: Unit normals, towards those who see them.
        rgb: Colours in [0, 1].
    """

    xyz: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    rgb: Float[np.ndarray, "n 3"]


def point_cloud(views: Sequence[SeenView], cell: float | None = None) -> Cloud:
    """The surfaces of views at one time, one point for all that lie in a cell and face the same way, as their mean.

    Cells are as wide as pixels are on the surfaces, or as `cell` says. Thin things keep their two sides apart: normals
    along other axes, or the other way, are other points.
    """
    kept = [agreed(views, n) for n in range(len(views))]
    xyz, normals, rgb = (
        np.concatenate(
            [getattr(view, part)[k].astype(np.float64) for view, k in zip(views, kept, strict=True)]
        )
        for part in ("points", "normals", "picture")
    )
    if not len(xyz):
        return Cloud(xyz, normals, rgb)
    cell = _pixel_width(views) if cell is None else cell
    axis = np.abs(normals).argmax(1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] < 0)
    place = np.floor((xyz - xyz.min(0)) / cell).astype(np.int64)
    keys = np.ravel_multi_index((*place.T, side), (*(place.max(0) + 1), 6))
    _, of, count = np.unique(keys, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(of, column) for column in values.T], axis=1) / count[:, None]

    normals = mean(normals)
    return Cloud(mean(xyz), normals / np.linalg.norm(normals, axis=1, keepdims=True), mean(rgb))


def _pixel_width(views: Sequence[SeenView]) -> float:
    """Median distance of the surfaces behind neighbouring pixels."""
    steps = [np.linalg.norm(np.diff(view.points, axis=1), axis=-1)[view.kept[:, 1:]] for view in views]
    return float(np.nanmedian(np.concatenate(steps)))
