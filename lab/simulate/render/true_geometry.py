"""Exact depth and flow of meshes that keep their faces while their vertices move.

A pixel sees, at its centre, a point of a triangle; the same barycentric coordinates on the moved triangle are
the same point at another time. All of it is computed in double precision from the number of the triangle.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.capture.camera import Camera
from devrf.lab.simulate.scenes.catalogue import Mesh

SAME_DEPTH = 0.01  # world units; nearer than this in depth is the same surface


@dataclass(frozen=True)
class TrueSurface:
    """What a camera sees at one time.

    Attributes:
        camera: Without distortion.
        triangle: Number of the triangle at each pixel's centre [H, W]; -1 for none.
        corners: All triangles [F, 3, 3] (corner, xyz) in the world at that time.
    """

    camera: Camera
    triangle: Int[np.ndarray, "h w"]
    corners: Float[np.ndarray, "f 3 3"]

    @property
    def depth(self) -> Float[np.ndarray, "h w"]:
        """Distance along the camera's z axis [H, W], world units; 0 where nothing is."""
        out = np.zeros(self.triangle.shape)
        seen = self.triangle >= 0
        out[seen] = self.depth_on(self.triangle[seen], _centres(self.camera)[seen])
        return out

    def depth_on(
        self, triangle: Int[np.ndarray, " n"], pixels: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, " n"]:
        """Depth [N] at which rays through pixels [N, 2] meet the planes of triangles."""
        rays, a, normal = self._meet(triangle, pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            return ((a - self.camera.centre) * normal).sum(-1) / (rays * normal).sum(-1)

    def barycentric(self) -> Float[np.ndarray, "n 3"]:
        """Of the point at each seen pixel's centre, in the order of `triangle[triangle >= 0]`."""
        seen = self.triangle >= 0
        triangle, pixels = self.triangle[seen], _centres(self.camera)[seen]
        rays, a, normal = self._meet(triangle, pixels)
        points = self.camera.centre + self.depth_on(triangle, pixels)[:, None] * rays
        b, c = self.corners[triangle, 1], self.corners[triangle, 2]
        square = (normal * normal).sum(-1)
        weight_b = (np.cross(points - a, c - a) * normal).sum(-1) / square
        weight_c = (np.cross(b - a, points - a) * normal).sum(-1) / square
        return np.stack([1 - weight_b - weight_c, weight_b, weight_c], -1)

    def _meet(self, triangle: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays of unit depth, and of each triangle a corner and its normal."""
        rays = self.camera.directions(pixels)
        rays = rays / (rays @ self.camera.cam_from_world[2, :3])[:, None]
        a, b, c = np.moveaxis(self.corners[triangle], 1, 0)
        return rays, a, np.cross(b - a, c - a)


def corners_of(meshes: Sequence[Mesh]) -> Float[np.ndarray, "f 3 3"]:
    """The triangles of all meshes in order [F, 3, 3]."""
    return np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])


def flow_bwd(
    now: TrueSurface, before: TrueSurface
) -> tuple[Float[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]:
    """Where the point seen at each pixel's centre was in the picture before.

    Args:
        now: What the camera sees at time t.
        before: What the same camera sees at time t - 1.
    Returns:
        Flow [H, W, 2] from t to t - 1, pixels, 0 where nothing is seen; and whether the point is in the
        picture before and the nearest pixel there sees it, or a surface at the same depth.
    """
    seen = now.triangle >= 0
    triangle, centres = now.triangle[seen], _centres(now.camera)[seen]
    points = (now.barycentric()[..., None] * before.corners[triangle]).sum(1)
    camera = before.camera
    place = camera.project(points)
    flow = np.zeros((*seen.shape, 2))
    flow[seen] = np.nan_to_num(place - centres)
    column, row = (np.floor(np.nan_to_num(place[:, i], nan=-1.0)).astype(int) for i in (0, 1))
    inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
    there = np.where(inside, before.triangle[np.where(inside, row, 0), np.where(inside, column, 0)], -1)
    depth = points @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    same = (there == triangle) | (np.abs(before.depth_on(there, place) - depth) < SAME_DEPTH)
    mask = np.zeros(seen.shape, bool)
    mask[seen] = inside & (there >= 0) & same
    return flow, mask


def _centres(camera: Camera) -> np.ndarray:
    """Pixel coordinates [H, W, 2] of all pixels' centres."""
    return np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1)
