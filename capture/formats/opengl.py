"""Cameras of transforms files: OpenGL axes (x right, y up, z back), camera-to-world, and intrinsics by name.

The second and third columns of a pose change sign between OpenGL's axes and ours. cx, cy count the centre of
the first pixel as (0.5, 0.5), as we do.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera, LensModel
from devrf.capture.errors import CaptureError
from devrf.capture.formats.files import Header, number

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
DISTORTION_KEYS: dict[LensModel, tuple[str, ...]] = {
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
RIGID_REPAIR = 1e-2  # poses in hand-made files are rounded; beyond this they are not rotations at all


def cam_from_opengl(matrix: Any, where: str) -> Float[np.ndarray, "3 4"]:
    """OpenGL camera-to-world [3 or 4, 4] to OpenCV world-to-camera; rounded rotations are made exact.

    Raises:
        CaptureError: Not a pose: of another shape, not finite, mirrored or not rigid. `where` names it.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape not in ((3, 4), (4, 4)):
        text = f"{where}: the pose has shape {list(pose.shape)}; expected 4 rows of 4 numbers"
        raise CaptureError("pose-wrong", text)
    if not np.isfinite(pose).all():
        wrong = f"{where}: the pose is not finite ({pose[:3].tolist()})"
        raise CaptureError("pose-not-finite", f"{wrong}; remove the picture, it was not registered")
    full = np.vstack([pose[:3], [0, 0, 0, 1]]) @ FLIP_YZ
    u, s, vt = np.linalg.svd(full[:3, :3])
    if np.abs(s - 1).max() > RIGID_REPAIR:
        wrong = f"{where}: the pose is not rigid (singular values {s.round(4).tolist()}, expected 1, 1, 1)"
        raise CaptureError("pose-not-rigid", f"{wrong}; take the scale out of its rotation")
    if np.linalg.det(full[:3, :3]) < 0:
        wrong = f"{where}: the pose is a mirror (determinant {np.linalg.det(full[:3, :3]):.3f}, expected 1)"
        raise CaptureError("pose-mirrored", f"{wrong}; one of its axes points the wrong way: turn it")
    R = (u @ vt).T
    return np.column_stack([R, -R @ full[:3, 3]])


def camera_of(entry: dict[str, Any], header: Header, where: str) -> Camera:
    """The camera that an entry (with the file's own keys below it) describes.

    `fl_x, fl_y, cx, cy, w, h` and distortion where given; else `camera_angle_x`, whose focal length is from the
    width, with square pixels and the principal point at the picture's middle.
    """
    width, height = header.width, header.height
    stated = tuple(
        int(number(entry.get(key, size), key, where)) for key, size in (("w", width), ("h", height))
    )
    if stated != (width, height):
        wrong = f"{header.path}: picture is {header.size}, {where} says {stated[0]}x{stated[1]}"
        raise CaptureError("picture-size-wrong", f"{wrong}; use the pictures that were calibrated")
    if "fl_x" in entry:
        fl_x = number(entry["fl_x"], "fl_x", where)
    elif "camera_angle_x" in entry:
        angle = number(entry["camera_angle_x"], "camera_angle_x", where)
        if not 0 < angle < np.pi:
            text = f"{where}: camera_angle_x is {angle}; expected radians between 0 and 3.14"
            raise CaptureError("entry-wrong", text)
        fl_x = 0.5 * width / np.tan(0.5 * angle)
    else:
        text = f"{where}: neither fl_x nor camera_angle_x given; one of them is needed"
        raise CaptureError("entry-missing", text)
    fl_y = number(entry.get("fl_y", fl_x), "fl_y", where)
    if min(fl_x, fl_y) <= 0:
        text = f"{where}: focal length is {fl_x}, {fl_y}; expected pixels above 0"
        raise CaptureError("entry-wrong", text)
    cx, cy = (number(entry.get(key, side / 2), key, where) for key, side in (("cx", width), ("cy", height)))
    K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1.0]])
    model: LensModel = "OPENCV_FISHEYE" if entry.get("camera_model") == "OPENCV_FISHEYE" else "OPENCV"
    lens = [number(entry.get(key, 0.0), key, where) for key in DISTORTION_KEYS[model]]
    distortion = np.array([*lens, 0.0][:5])
    return Camera(width, height, K, cam_from_opengl(entry["transform_matrix"], where), distortion, model)


def intrinsics_entry(camera: Camera) -> dict[str, Any]:
    """A camera's size and intrinsics under nerfstudio's names, without distortion."""
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(camera.K[0, 0]),
        "fl_y": float(camera.K[1, 1]),
        "cx": float(camera.K[0, 2]),
        "cy": float(camera.K[1, 2]),
    }


def opengl_pose(camera: Camera) -> list[list[float]]:
    """`transform_matrix`: camera-to-world [4, 4] in OpenGL's axes."""
    return (camera.world_from_cam @ FLIP_YZ).tolist()
