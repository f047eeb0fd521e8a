"""Cameras of transforms files: OpenGL axes (x right, y up, z back), camera-to-world, and intrinsics by name.

The second and third columns of a pose change sign between OpenGL's axes and ours. cx, cy count the centre of
the first pixel as (0.5, 0.5), as we do.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera, LensModel
from devrf.capture.formats.parts.files import Header, number
from devrf.capture.system.errors import CaptureError

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
DISTORTION_KEYS: dict[LensModel, tuple[str, ...]] = {
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
MODELS: dict[
    str, LensModel
] = {  # nerfstudio's words, and COLMAP's, for lenses whose coefficients are k1, k2, ...
    "OPENCV": "OPENCV",
    "PINHOLE": "OPENCV",
    "SIMPLE_PINHOLE": "OPENCV",
    "PERSPECTIVE": "OPENCV",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "FULL_OPENCV": "OPENCV",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_FISHEYE": "OPENCV_FISHEYE",
    "FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
}
# that files may have; a lens has some of them, none that is read those from s1 on
COEFFICIENTS = (
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
    "s1",
    "s2",
    "s3",
    "s4",
    "tau_x",
    "tau_y",
    "skew",
)
OTHER_PROJECTIONS = ("latlong", "equirectangular", "orthographic", "ftheta_")  # as keys of instant-ngp begin
# further keys by which a pixel looks elsewhere: of instant-ngp, and a lens by names of other programs
UNREAD = (
    "rolling_shutter", "fisheye", "distortion", "distortions", "distortion_params", "distortion_coefficients",
    "distortion_coeffs", "distortion_coefs", "dist_coeffs", "dist_coeff", "dist",
)  # fmt: skip
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

    `fl_x, fl_y, cx, cy, w, h` and distortion where given; else `camera_angle_x` and `camera_angle_y`, whose focal
    lengths are from width and height. Without those of y, pixels are square; without cx, cy the principal point is
    at the picture's middle. The lens is `camera_model`, or a fisheye by instant-ngp's `is_fisheye`.

    Raises:
        CaptureError: A value that is none, or a lens that is not read.
    """
    width, height = header.width, header.height
    stated = tuple(
        int(number(entry.get(key, size), key, where)) for key, size in (("w", width), ("h", height))
    )
    if stated != (width, height):
        wrong = f"{header.path}: picture is {header.size}, {where} says {stated[0]}x{stated[1]}"
        raise CaptureError("picture-size-wrong", f"{wrong}; use the pictures that were calibrated")
    fl_x = _focal_length(entry, "x", width, where)
    if fl_x is None:
        text = f"{where}: neither fl_x nor camera_angle_x given; one of them is needed"
        raise CaptureError("entry-missing", text)
    fl_y = _focal_length(entry, "y", height, where)
    fl_y = fl_x if fl_y is None else fl_y
    if min(fl_x, fl_y) <= 0:
        text = f"{where}: focal length is {fl_x}, {fl_y}; expected pixels above 0"
        raise CaptureError("entry-wrong", text)
    cx, cy = (number(entry.get(key, side / 2), key, where) for key, side in (("cx", width), ("cy", height)))
    K = np.array([[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1.0]])
    model = _lens_model(entry, where)
    lens = {key: number(entry.get(key, 0.0), key, where) for key in COEFFICIENTS}
    keys = DISTORTION_KEYS[model]
    if beyond := [f"{key} = {value:g}" for key, value in lens.items() if value and key not in keys]:
        wrong = f"{where}: {', '.join(beyond)} cannot be held; expected {', '.join(keys)} of {model}"
        raise CaptureError("lens-unread", f"{wrong}; undistort the pictures, or calibrate without them")
    distortion = np.array([*(lens[key] for key in keys), 0.0][:5])
    return Camera(width, height, K, cam_from_opengl(entry["transform_matrix"], where), distortion, model)


def _focal_length(entry: dict[str, Any], axis: str, side: int, where: str) -> float | None:
    """Pixels, by `fl_x` or `camera_angle_x` (or those of y); None where there is neither."""
    length, angle = f"fl_{axis}", f"camera_angle_{axis}"
    if length in entry:
        return number(entry[length], length, where)
    if angle not in entry:
        return None
    value = number(entry[angle], angle, where)
    if not 0 < value < np.pi:
        raise CaptureError("entry-wrong", f"{where}: {angle} is {value}; expected radians between 0 and 3.14")
    return 0.5 * side / np.tan(0.5 * value)


def _lens_model(entry: dict[str, Any], where: str) -> LensModel:
    """By `camera_model`, which may be null, and `is_fisheye`."""
    said, flag = entry.get("camera_model"), entry.get("is_fisheye")
    for key in [key for key in entry if key.startswith(OTHER_PROJECTIONS)]:
        if entry[key] is not None and entry[key] is not False:
            wrong = f"{where}: {key} is {entry[key]!r}, another projection, which is not read"
            raise CaptureError(
                "lens-unread", f"{wrong}; expected {', '.join(MODELS)}; undistort the pictures"
            )
    for key in [key for key in UNREAD if not _is_nothing(entry.get(key))]:
        wrong = f"{where}: {key} is {entry[key]!r}, which is not read"
        expected = ", ".join(DISTORTION_KEYS["OPENCV"])
        remedy = "name the lens by camera_model and its coefficients, or undistort the pictures"
        raise CaptureError("lens-unread", f"{wrong}; expected {expected}; {remedy}")
    if said is not None and (not isinstance(said, str) or said not in MODELS):
        wrong = f"{where}: camera_model {said} is not read; expected {', '.join(MODELS)}"
        raise CaptureError("lens-unread", f"{wrong}; undistort the pictures")
    if flag not in (None, False, True):
        raise CaptureError("entry-wrong", f"{where}: is_fisheye is {flag!r}; expected true or false")
    flagged: LensModel = "OPENCV_FISHEYE" if flag else "OPENCV"
    model = flagged if said is None else MODELS[said]
    if flag and model != flagged:
        wrong = f"{where}: camera_model is {said} and is_fisheye is true; expected one lens"
        raise CaptureError("lens-unread", f"{wrong}; remove the one that is not true")
    return model


def _is_nothing(value: Any) -> bool:
    """Whether a key says nothing: null, false, zeros, a list or a matrix of them."""
    rows = value if isinstance(value, list) else [value]
    return not any(any(row) if isinstance(row, list) else row for row in rows)


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
