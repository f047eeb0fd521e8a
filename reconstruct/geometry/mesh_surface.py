"""The scene's surface at a time as a triangle mesh: a level of the opacity, and the same mesh moved to other times.

What walks through the cells (marching cubes) is handed in, so that nothing here needs the library that has it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.geometry.field import AT_ONCE, Field, brightness, opacity_grid
from devrf.reconstruct.geometry.seen import SeenView, colours_of
from devrf.reconstruct.rendering.model import DynamicModel

LEVEL = 0.5  # a layer of a voxel's thickness absorbs half of the light
CRUMB_FACES = 100  # connected pieces with fewer are left out: less than three voxels across
COMPARED = 5000  # vertices, spread over a mesh

March = Callable[[np.ndarray, float], tuple[np.ndarray, np.ndarray]]
"""Level set of a volume: vertices in voxels [v, 3], faces [f, 3], counter-clockwise seen from where it is lower."""


@dataclass(frozen=True)
class SurfaceMesh:
    """A mesh.

    Attributes:
        x: Vertices in the coordinates of the model's grids, on the model's device.
        vertices: The same in the box frame.
        faces: Vertex numbers, counter-clockwise from outside.
        crumbs: Small pieces that were left out.
    """

    x: Float32[Tensor, "v 3"]
    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    crumbs: int


def surface_of(field: Field, level: float, march: March) -> SurfaceMesh:
    """The surface at a field's time.

    Raises:
        ReconstructError: Nothing is that opaque.
    """
    grid = opacity_grid(field, field.shape).numpy()
    if not grid.max() > level > grid.min():
        raise _nothing(level, f"the model's opacity lies between {grid.min():.3g} and {grid.max():.3g} here")
    vertices, faces = march(grid, level)
    vertices, faces, crumbs = _without_crumbs(vertices, faces)
    if not len(faces):
        raise _nothing(level, f"only {crumbs} crumbs of less than three voxels")
    lo, span = field.aabb[0].numpy(), (field.aabb[1] - field.aabb[0]).numpy()
    place = torch.from_numpy((lo + vertices / (np.array(grid.shape) - 1) * span).astype(np.float32))
    place = place.to(field.canonical.density.device)
    return SurfaceMesh(place, _box(field, place), faces, crumbs)


def moved(surface: SurfaceMesh, field: Field) -> Float[np.ndarray, "v 3"]:
    """Where the vertices of a surface at rest are at a field's time, in the box frame (forward motion)."""
    return np.concatenate([_box(field, field.from_rest(x)) for x in surface.x.split(AT_ONCE)])


def rested(surface: SurfaceMesh, field: Field) -> Float[np.ndarray, "v 3"]:
    """Where the vertices of a surface at a field's time rest, in the box frame (backward motion)."""
    return np.concatenate([_box(field, field.to_rest(x)) for x in surface.x.split(AT_ONCE)])


def coloured(views: Sequence[SeenView], surface: SurfaceMesh, field: Field) -> Float[np.ndarray, "v 3"]:
    """Colours in [0, 1] of a surface at a field's time.

    Args:
        views: Of the scene at rest (`resting`): colours move along, and change with the light.
        surface: What is coloured.
        field: At its time.
    """
    vertices = rested(surface, field)
    rgb = colours_of(views, field.at_rest(), vertices, normals_of(vertices, surface.faces))
    light = torch.cat([brightness(field, x) for x in surface.x.split(AT_ONCE)])
    return (rgb * light.cpu().numpy()).clip(max=1)


def resting(model: DynamicModel) -> DynamicModel:
    """The scene at rest with the colours that it has in motion; with movers those at rest, which their layers share."""
    if model.in_motion is None or model.movers is not None:
        return DynamicModel(model.rest, chunk=model.chunk)
    rest = replace(model.in_motion, shell=model.rest.shell)
    return DynamicModel(rest, chunk=model.chunk)


def normals_of(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, "v 3"]:
    """Outward unit normals of vertices: the mean over their faces, by area."""
    a, b, c = (vertices[faces[:, n]] for n in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for n in range(3):
        np.add.at(total, faces[:, n], across)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def apart(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, " k"]:
    """Distances between two meshes: from vertices of each, spread over it, to the nearest vertex of the other."""
    some = [p[np.linspace(0, len(p) - 1, min(COMPARED, len(p))).astype(int)] for p in (a, b)]
    return np.concatenate([KDTree(b).query(some[0])[0], KDTree(a).query(some[1])[0]])


def _nothing(level: float, why: str) -> ReconstructError:
    text = f"nothing solid found at level {level:g}: {why}; give another --level, or look at the model with render"
    return ReconstructError("model-without-surface", text)


def _box(field: Field, x: Float[Tensor, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return field.to_box(x).cpu().numpy().astype(np.float64)


def _without_crumbs(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"], int]:
    """The large connected pieces, and the number of those that were left out."""
    ends = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    edges = coo_matrix((np.ones(ends.shape[1]), tuple(ends)), shape=(len(vertices), len(vertices)))
    count, piece = connected_components(edges, directed=False)
    of_face = piece[faces[:, 0]]
    large = np.bincount(of_face, minlength=count) >= CRUMB_FACES
    kept = large[piece]
    number = np.cumsum(kept) - 1
    return vertices[kept], number[faces[large[of_face]]], int(count - large.sum())
