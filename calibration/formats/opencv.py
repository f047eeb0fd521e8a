"""Calibrations written by OpenCV (`cv2.FileStorage`, yml or xml) and by ROS (`camera_info` yaml), in and out.

Read:
- as yml, xml or JSON.
- one camera (OpenCV's calibration samples, ROS): `camera_matrix`, `distortion_coefficients`, `image_width`,
  `image_height`; a folder of such files has one camera in each. Intrinsics only.
- a stereo pair (OpenCV's stereo sample): M1, D1, M2, D2 in intrinsics.yml, R and T in extrinsics.yml beside it
  (x2 = R x1 + T, in the unit of the board's squares).
OpenCV has no file for more than two cameras. We write one camera a file with one key more: `cam_from_world` (3x4).
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from devrf.calibration.formats.found import (
    FoundCalibration,
    FoundCamera,
    cv_coefficients,
    distortion_of,
    matrix,
    numbers,
    pose,
    size_of,
    text_of,
)
from devrf.calibration.intrinsics import HALF_PIXEL
from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError

ENDINGS = (".yml", ".yaml", ".xml", ".json")
MATRIX_KEYS = ("camera_matrix", "Camera_Matrix")  # the second by OpenCV before 3.0
DISTORTION_KEYS = ("distortion_coefficients", "Distortion_Coefficients")
WIDTH_KEYS, HEIGHT_KEYS = ("image_width", "image_Width"), ("image_height", "image_Height")
ROS_MODELS = {"plumb_bob": False, "rational_polynomial": False, "equidistant": True, "fisheye": True}
SINGLE, STEREO = "OpenCV, one camera a file", "OpenCV stereo pair"
INTRINSICS_FILE, EXTRINSICS_FILE = "intrinsics.yml", "extrinsics.yml"


def storage(text: str) -> dict[str, Any] | None:
    """A file of OpenCV's as plain values; matrices as arrays; None if it is none.

    FileStorage reads ROS's yaml too, which has no `%YAML:1.0` line.
    """
    if text.lstrip().startswith("{"):
        try:
            return _plain(json.loads(text))
        except (ValueError, RecursionError):
            return None
    try:
        file = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = file.root()
        return {key: _value(root.getNode(key)) for key in root.keys()} if root.isMap() else None
    except (cv2.error, SystemError):  # SystemError: how OpenCV 5.0's binding reports a parse error
        return None


def is_single(data: Mapping[str, Any]) -> bool:
    """Whether a file describes one camera."""
    return any(key in data for key in MATRIX_KEYS)


def is_stereo(data: Mapping[str, Any]) -> bool:
    """Whether a file is one of a stereo pair's two."""
    return "M1" in data or {"R", "T"} <= set(data) and not is_single(data)


def read_single(path: Path, data: Mapping[str, Any]) -> FoundCamera:
    """One camera's file."""
    key = _first(data, MATRIX_KEYS)
    if data.get("xi") not in (None, 0):
        wrong = f"{path}: xi is {np.ravel(data['xi']).tolist()}, of OpenCV's omnidirectional lens, which is not read"
        raise InputError("lens-unread", f"{wrong}; calibrate the lens as a fisheye (cv2.fisheye)")
    name = data.get("distortion_model")
    if name is not None and str(name) not in ROS_MODELS:
        text = f"{path}: distortion_model is {name!r}; expected {', '.join(ROS_MODELS)}"
        raise InputError("lens-unread", text)
    fisheye = ROS_MODELS.get(str(name), False) or bool(data.get("fisheye_model", 0))
    width, height = data.get(_first(data, WIDTH_KEYS)), data.get(_first(data, HEIGHT_KEYS))
    size = None if width is None or height is None else size_of([width, height], f"{path}: image size")
    given_pose = data.get("cam_from_world")
    cam_from_world = None
    if given_pose is not None:
        T = numbers(given_pose, (3, 4), f"{path}: cam_from_world")
        cam_from_world = pose(T[:, :3], T[:, 3], f"{path}: cam_from_world")
    return FoundCamera(
        matrix(data.get(key), f"{path}: {key}"),
        distortion_of(data, DISTORTION_KEYS, f"{path}", fisheye),
        "OPENCV_FISHEYE" if fisheye else "OPENCV",
        size,
        cam_from_world,
    )


def read_singles(files: Mapping[str, tuple[Path, Mapping[str, Any]]]) -> FoundCalibration:
    """Several cameras, one file each; camera name -> (path, content)."""
    cameras = {name: read_single(path, data) for name, (path, data) in files.items()}
    metric = all(data.get("length_unit") == "metre" for _, data in files.values())
    return FoundCalibration(SINGLE, cameras, "m" if metric else "arbitrary")


def read_stereo(path: Path, data: Mapping[str, Any]) -> FoundCalibration:
    """A stereo pair: `path` is either of its files; the other is looked for beside it."""
    both = dict(data)
    if "M1" not in both or "R" not in both:
        name = INTRINSICS_FILE if "M1" not in both else EXTRINSICS_FILE
        other = path.with_name(name).with_suffix(path.suffix)
        more = storage(text_of(other)) if other.is_file() and other != path else None
        if more is None and "M1" not in both:
            text = f"{path}: has R and T, but no M1; expected {other.name} beside it; copy it there"
            raise InputError("file-missing", text)
        both |= more or {}
    cameras = {}
    for n in (1, 2):
        cam_from_world = None
        if "R" in both and "T" in both:
            R, t = (np.eye(3), np.zeros(3)) if n == 1 else (both["R"], both["T"])
            cam_from_world = pose(R, t, f"{path}: R and T")
        K = matrix(both.get(f"M{n}"), f"{path}: M{n}")
        lens = distortion_of(both, [f"D{n}"], f"{path}", others=())
        cameras[str(n)] = FoundCamera(K, lens, cam_from_world=cam_from_world)
    return FoundCalibration(STEREO, cameras, "unsaid")


def write_opencv(folder: Path, cameras: Mapping[str, Camera], metric: bool) -> None:
    """One file a camera; `cam_from_world` and `length_unit` are ours."""
    for name, camera in cameras.items():
        file = cv2.FileStorage(str(folder / f"{name}.yml"), cv2.FILE_STORAGE_WRITE)
        file.write("image_width", camera.width)
        file.write("image_height", camera.height)
        file.write("camera_matrix", camera.K - HALF_PIXEL)
        file.write("distortion_coefficients", np.array([cv_coefficients(camera)]))
        file.write("fisheye_model", int(camera.model == "OPENCV_FISHEYE"))
        file.write("cam_from_world", camera.cam_from_world)
        file.write("length_unit", "metre" if metric else "arbitrary")
        file.release()


def _value(node: Any) -> Any:
    if node.isMap():
        return _map({key: _value(node.getNode(key)) for key in node.keys()})
    if node.isSeq():
        return [_value(node.at(n)) for n in range(node.size())]
    if node.isInt():
        return int(node.real())
    if node.isReal():
        return node.real()
    return node.string() if node.isString() else None


def _plain(value: Any) -> Any:
    """A JSON value, its matrices as arrays."""
    if isinstance(value, dict):
        return _map({key: _plain(inner) for key, inner in value.items()})
    return [_plain(inner) for inner in value] if isinstance(value, list) else value


def _map(found: dict[str, Any]) -> Any:
    """A map as it is; a matrix as an array, or as the list of its numbers where they are not as many as it says."""
    rows, cols, data = (found.get(key) for key in ("rows", "cols", "data"))
    if isinstance(rows, int) and isinstance(cols, int) and isinstance(data, list):
        nested = any(isinstance(value, list | dict | np.ndarray) for value in data)
        whole = min(rows, cols) > 0 and len(data) == rows * cols and not nested
        return np.array(data, dtype=object).reshape(rows, cols) if whole else data
    return found


def _first(data: Mapping[str, Any], keys: tuple[str, ...]) -> str:
    return next((key for key in keys if key in data), keys[0])
