"""Depth as a film shows it: along the camera's axis, of what is seen in the box; surroundings have none."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from devrf.capture.camera import Camera
from devrf.reconstruct.evaluation.error_map import inferno
from devrf.reconstruct.rendering.model import SOLID, Layers
from devrf.reconstruct.rendering.rays import pixel_directions

MILLIMETRE = 0.001
MOST_STEPS = 65_000  # of a 16-bit depth picture; 0 is nothing


@dataclass(frozen=True)
class DepthScale:
    """How depth is shown in all pictures of a film.

    Attributes:
        near, far: Depths of the brightest and the darkest colour, world units.
        unit: World units of one step of a 16-bit picture.
        world_per_box: World units of a unit of the box frame.
    """

    near: float
    far: float
    unit: float
    world_per_box: float

    @staticmethod
    def of(
        path: Sequence[Camera],
        aabb: Float[np.ndarray, "2 3"],
        near: float,
        world_per_box: float,
        metric: bool,
    ) -> "DepthScale":
        """From where a path's cameras have the box; `near` is where rays begin, in the box frame."""
        corners = np.stack(np.meshgrid(*aabb.T, indexing="ij"), axis=-1).reshape(-1, 3)
        depths = np.array([corners @ c.cam_from_world[2, :3] + c.cam_from_world[2, 3] for c in path])
        far = max(float(depths.max()), 2 * near)
        least = min(max(float(depths.min()), near), 0.9 * far)
        fits = MILLIMETRE if metric else 0.0
        unit = max(fits, far * world_per_box / MOST_STEPS)
        return DepthScale(least * world_per_box, far * world_per_box, unit, world_per_box)


def planar_depth(camera: Camera, layers: Layers, scale: DepthScale) -> Float32[np.ndarray, "h w"]:
    """Depth along the camera's axis, world units; 0 where nothing solid is seen in the box."""
    _, away, opacity = layers
    surface = camera.centre + (away / np.maximum(opacity, SOLID))[..., None] * pixel_directions(camera)
    axis = camera.cam_from_world[2]
    depth = (surface @ axis[:3] + axis[3]) * scale.world_per_box
    return np.where(opacity > SOLID, np.maximum(depth, scale.unit), 0).astype(np.float32)


def depth_steps(depth: Float32[np.ndarray, "h w"], scale: DepthScale) -> UInt16[np.ndarray, "h w"]:
    """Depth in steps of `scale.unit`."""
    return np.clip(np.round(depth / scale.unit), 0, 65_535).astype(np.uint16)


def depth_colours(depth: Float32[np.ndarray, "h w"], scale: DepthScale) -> UInt8[np.ndarray, "h w 3"]:
    """Depth in colours, near is bright, even in 1 / depth; black where there is none."""
    inverse = 1 / np.maximum(depth, scale.unit)
    share = (inverse - 1 / scale.far) / (1 / scale.near - 1 / scale.far)
    colours = inferno(0.15 + 0.85 * np.clip(share, 0, 1))  # what is far is not black yet
    return np.round(255 * np.where(depth[..., None] > 0, colours, 0)).astype(np.uint8)
