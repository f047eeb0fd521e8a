"""Faces that nothing shows at rest: where a part stands on something, and what is behind its own surface.

When it turns they come into view. A part is taken to be closed: what is hidden belongs to it inside the convex hull
of its surface. It gets opaque there, in the colours of the surface next to it, which training replaces.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import Delaunay, KDTree, QhullError
from torch import Tensor

from devrf.reconstruct.fields.canonical import Canonical, raw_density
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.geometry.seen import SeenView

OPTICAL = math.log(2)  # depth of a step that is given to what is hidden: half opaque


def hidden_at_rest(views: Sequence[SeenView], canonical: Canonical) -> Bool[Tensor, "X Y Z"]:
    """Vertices that lie behind a surface in every view that has them in its picture."""
    places = vertices(canonical.aabb, canonical.shape).reshape(-1, 3).numpy().astype(np.float64)
    hidden = np.ones(len(places), dtype=bool)
    for view in views:
        left = np.flatnonzero(hidden)
        at = view.camera.project(places[left])
        size = [view.camera.width, view.camera.height]
        inside = np.isfinite(at).all(1) & (at >= 0).all(1) & (at < size).all(1)
        left, (x, y) = left[inside], at[inside].astype(int).T
        away = np.linalg.norm(view.points[y, x] - view.camera.centre, axis=1)
        # Where nothing is solid it is not a number: looked through.
        hidden[left] = away < np.linalg.norm(places[left] - view.camera.centre, axis=1)
    return torch.from_numpy(hidden.reshape(canonical.shape)).to(canonical.density.device)


def labels_of_hidden(
    canonical: Canonical,
    hidden: Bool[Tensor, "X Y Z"],
    xyz: Float[np.ndarray, "p 3"],
    labels: Int[np.ndarray, " p"],
) -> UInt8[Tensor, "X Y Z"]:
    """The part that hidden vertices belong to, counted from 1; 0: none.

    Args:
        canonical: The scene at rest.
        hidden: Of its vertices.
        xyz: Surface points of the parts.
        labels: Part of each, counted from 0.
    """
    out = torch.zeros(canonical.shape, dtype=torch.uint8)
    at = hidden.cpu().nonzero()
    places = vertices(canonical.aabb, canonical.shape)[tuple(at.T)].numpy()
    for part in range(labels.max() + 1):
        mine = xyz[labels == part]
        near = np.flatnonzero(((places >= mine.min(0)) & (places <= mine.max(0))).all(1))
        try:
            inside = near[Delaunay(mine).find_simplex(places[near]) >= 0]
        except (QhullError, ValueError):  # few points, or in a plane
            continue
        out[tuple(at[inside].T)] = part + 1
    return out.to(hidden.device)


def fill(canonical: Canonical, shown: Bool[Tensor, "X Y Z"], filled: Bool[Tensor, "X Y Z"]) -> None:
    """Make a scene of parts opaque where it is filled, in the colours of what is shown next to it."""
    if not bool(filled.any()):
        return
    places = vertices(canonical.aabb, canonical.shape)
    source = shown.cpu().nonzero()
    nearest = KDTree(places[tuple(source.T)].numpy()).query(places[filled.cpu()].numpy())[1]
    canonical.density[filled] = canonical.density[filled].clamp_min(raw_density(canonical, OPTICAL))
    canonical.features = canonical.features.clone()  # those of the scene at rest stay
    canonical.features[filled] = canonical.features[tuple(source[nearest].T)]
    canonical.rebuild_occupancy()
