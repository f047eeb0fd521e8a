"""Poses of COLMAP's models: world to camera, OpenCV's axes, as a unit quaternion and a translation."""

import numpy as np

from devrf.capture.formats.colmap.colmap_model import ModelImage
from devrf.capture.system.errors import CaptureError


def pose(image: ModelImage, where: str) -> np.ndarray:
    """cam_from_world [3, 4] of a registered picture.

    Raises:
        CaptureError: Not finite, or not a rotation.
    """
    length = np.linalg.norm(image.quat_wxyz)
    if not (0.5 < length < np.inf and np.isfinite(image.translation).all()):
        values = [*image.quat_wxyz.tolist(), *image.translation.tolist()]
        text = f"{where}: the pose is not one ({values}); remove the image from the model"
        raise CaptureError("pose-wrong", text)
    w, x, y, z = image.quat_wxyz / length
    v = np.array([x, y, z])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    R = (w * w - v @ v) * np.eye(3) + 2 * np.outer(v, v) + 2 * w * cross
    return np.column_stack([R, image.translation])


def quat_wxyz(R: np.ndarray) -> np.ndarray:
    """Unit quaternion [4] of a rotation, w >= 0: the eigenvector of Bar-Itzhack's matrix (JGCD 23(6), 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a - e - i, b + d, c + g, h - f],
            [b + d, e - a - i, f + h, c - g],
            [c + g, f + h, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)
