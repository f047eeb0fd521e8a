"""What moves in truth: where a camera sees it, and the way of points on its surface."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.capture.camera import Camera
from devrf.lab.simulate.render.renderer import lens_of
from devrf.lab.simulate.render.studio import Studio
from devrf.lab.simulate.render.true_geometry import corners_of
from devrf.lab.simulate.scenes.catalogue import Mesh

MOVED_M = 0.005  # a triangle has moved whose corners are farther than this from where they rest
POINTS = 2000  # of the surface, whose way is written


class MovedMasks:
    """Masks of what moves in one camera's pictures."""

    def __init__(self, camera: Camera, rest: Sequence[Mesh], still: Sequence[Mesh]) -> None:
        """`rest` are the meshes that can move, where they rest; `still` all others."""
        self._still, self._studio, self._lens = list(still), Studio(spp=1), lens_of(camera)
        self._pinhole = self._lens.pinhole(camera)
        self._corners = corners_of(rest)
        self._at_rest = self._triangles(rest)

    def __call__(self, now: Sequence[Mesh]) -> Bool[np.ndarray, "h w"]:
        """Pixels that show, now or at rest, a surface that is now elsewhere than at rest."""
        gone = (np.linalg.norm(corners_of(now) - self._corners, axis=-1) > MOVED_M).any(-1)
        gone = np.append(gone, False)  # number -1: what stands
        shown = np.stack([gone[self._triangles(now)], gone[self._at_rest]], axis=-1)
        return self._lens.gathered(shown.astype(np.float32)).max(-1) >= 0.5

    def _triangles(self, moving: Sequence[Mesh]) -> Int[np.ndarray, "h w"]:
        """Numbers of the triangles of `moving` in a picture without distortion; -1 where something else is seen."""
        numbers = self._studio.stage([*moving, *self._still]).triangles(self._pinhole)
        return np.where(numbers < len(self._corners), numbers, -1)


def ways(meshes_at: Sequence[Mesh]) -> Float[np.ndarray, "times n 3"]:
    """Where `POINTS` points of a surface are, spread evenly over it at first: one mesh for every time."""
    rng, first = np.random.default_rng(0), meshes_at[0]
    a, b, c = first.vertices[first.faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    faces = first.faces[rng.choice(len(area), POINTS, p=area / area.sum())]
    weights = rng.dirichlet((1.0, 1.0, 1.0), POINTS)
    moved = [np.einsum("nk,nki->ni", weights, mesh.vertices[faces]) for mesh in meshes_at]
    return np.stack(moved).astype(np.float32)
