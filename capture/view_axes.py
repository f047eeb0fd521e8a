"""Where cameras look: at a target, at the point that view axes meet in, and whether what they see lies before them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.scene import SparsePoints


def look_at(
    position: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
    up: Sequence[float] | Float[np.ndarray, "3"] = (0.0, 0.0, 1.0),
    roll_deg: float = 0.0,
) -> Float[np.ndarray, "3 4"]:
    """cam_from_world of a camera at `position` that looks at `target`, `up` in its picture, but for a roll."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.stack([x, np.cross(z, x), z])
    return np.column_stack([R, -R @ position])


def closest_point(
    centres: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3"]:
    """The point with the least squared distance to lines through `centres` along unit `rays`."""
    away = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.linalg.lstsq(away.sum(0), (away @ centres[:, :, None]).sum(0)[:, 0], rcond=None)[0]


def behind(cameras: Sequence[Camera], points: SparsePoints | None) -> float:
    """Share of what cameras see that lies behind them, where no camera sees: their axes point the wrong way.

    Of the sightings of sparse points; without points, of the place where the view axes meet, for each camera.

    Args:
        cameras: Of the pictures at rest.
        points: Seen in these pictures.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_world[2, :3] for camera in cameras])
    if points is None:
        seen, by = closest_point(centres, axes)[None], np.arange(len(cameras))
    else:
        seen, by = points.xyz[points.obs_point], points.obs_frame
    depth = ((seen - centres[by]) * axes[by]).sum(-1)
    return float((depth <= 0).mean()) if len(depth) else 0.0
