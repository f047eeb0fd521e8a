"""A view as a camera of the model, and the depth that other things in space are hidden by."""

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

from devrf.capture.camera import Camera
from devrf.reconstruct.model import SOLID


def pinhole(
    position: Float[np.ndarray, "3"], wxyz: Float[np.ndarray, "4"], fov_rad: float, width: int, height: int
) -> Camera:
    """A camera without distortion, its principal point in the middle, pixels square.

    Args:
        position: Its centre in the world.
        wxyz: Unit quaternion of its axes in the world (+x right, +y down, +z forward).
        fov_rad: Vertical field of view.
        width, height: Of the picture, pixels.
    """
    R = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
    f = height / 2 / np.tan(fov_rad / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Camera(width, height, K, np.column_stack([R.T, -R.T @ position]))


def hiding_depth(
    depth: Float[np.ndarray, "h w"],
    opacity: Float[np.ndarray, "h w"],
    camera: Camera,
    nothing: float,
    most_pixels: int,
) -> Float32[np.ndarray, "hs ws"]:
    """Depth along the camera's axis of what hides things behind it, on every n-th pixel.

    Args:
        depth, opacity: As `render_layers` gives them.
        camera: Without lens distortion.
        nothing: Depth where nothing hides anything.
        most_pixels: About how many are wanted at most.
    """
    step = max(1, int(np.ceil(np.sqrt(depth.size / most_pixels))))
    rows, columns = (slice(n % step // 2 + step // 2, None, step) for n in depth.shape)
    u, v = np.arange(camera.width)[columns] + 0.5, np.arange(camera.height)[rows] + 0.5
    x, y = (u - camera.K[0, 2]) / camera.K[0, 0], (v - camera.K[1, 2]) / camera.K[1, 1]
    along = 1 / np.sqrt(1 + x**2 + y[:, None] ** 2)
    solid = opacity[rows, columns]
    z = depth[rows, columns] / np.maximum(solid, SOLID) * along
    return np.where(solid >= SOLID, z, nothing).astype(np.float32)
