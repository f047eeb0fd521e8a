"""Rigs as JSON: of the Panoptic Studio and programs that write its keys, and of multical.

- Panoptic: `cameras`, a list of `name`, `resolution`, `K`, `distCoef`, `R`, `t`; centimetres.
- multical: `cameras`, a map of `image_size`, `K`, `dist`, and `camera_poses` with `R` and `T` of each, called as the
  camera, or `<camera>_to_<first>`; in the unit of its board.

x_cam = R x_world + t; pixels count from the centre of the first one.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from devrf.calibration.formats.found import (
    FoundCalibration,
    FoundCamera,
    distortion_of,
    matrix,
    pose,
    size_of,
)


def parse(text: str) -> dict[str, Any] | None:
    """The file; None if the text is neither."""
    if not text.lstrip().startswith("{"):
        return None
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        return None
    cameras = data.get("cameras")
    if isinstance(cameras, list):
        known = all(isinstance(c, dict) and {"K", "R", "t"} <= set(c) for c in cameras)
        return data if cameras and known else None
    if not isinstance(cameras, dict) or not isinstance(data.get("camera_poses"), dict):
        return None
    return data if all(isinstance(c, dict) and "K" in c for c in cameras.values()) else None


def read_json_cameras(path: Path, data: Mapping[str, Any]) -> FoundCalibration:
    """Either of the two."""
    if isinstance(data["cameras"], list):
        cameras = [_panoptic(path, n, camera) for n, camera in enumerate(data["cameras"])]
        return FoundCalibration("Panoptic Studio", dict(cameras), "cm")
    poses = {str(key).split("_to_")[0]: value for key, value in data["camera_poses"].items()}
    return FoundCalibration(
        "multical",
        {str(name): _multical(path, str(name), c, poses) for name, c in data["cameras"].items()},
        "unsaid",
    )


def _panoptic(path: Path, number: int, camera: Mapping[str, Any]) -> tuple[str, FoundCamera]:
    name = str(camera.get("name", number))
    where = f"{path}: camera {name}"
    return name, FoundCamera(
        matrix(camera["K"], f"{where}: K"),
        distortion_of(camera, ["distCoef"], where),
        size=None
        if camera.get("resolution") is None
        else size_of(camera["resolution"], f"{where}: resolution"),
        cam_from_world=pose(camera["R"], camera["t"], where),
    )


def _multical(path: Path, name: str, camera: Mapping[str, Any], poses: Mapping[str, Any]) -> FoundCamera:
    where, placed = f"{path}: camera {name}", poses.get(name)
    given, fisheye = placed if isinstance(placed, dict) else {}, camera.get("model") == "fisheye"
    return FoundCamera(
        matrix(camera["K"], f"{where}: K"),
        distortion_of(camera, ["dist"], where, fisheye),
        size=None
        if camera.get("image_size") is None
        else size_of(camera["image_size"], f"{where}: image_size"),
        cam_from_world=pose(given.get("R"), given.get("T"), where) if given else None,
        model="OPENCV_FISHEYE" if fisheye else "OPENCV",
    )
