"""kalibr's camchain yaml (kalibr wiki, "yaml formats").

cam0, cam1, ...: `camera_model`, `intrinsics` (fu fv pu pv), `distortion_model`, `distortion_coeffs`, `resolution`, and
from the second camera on `T_cn_cnm1`, which takes points of the camera before it into this one; metres. The world is
cam0. Pixels count from the centre of the first one. The topic (`/<name>/image_raw`) names a camera where each has
its own; else the key does. Where an IMU is (`T_cam_imu`) does not matter here.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from devrf.calibration.formats.found import (
    FoundCalibration,
    FoundCamera,
    distortion_of,
    focal_matrix,
    numbers,
    pose,
    size_of,
)
from devrf.capture.photos.picture_files import natural_key
from devrf.capture.system.errors import InputError

FORMAT = "kalibr camchain"
LENSES = {"radtan": False, "none": False, "equidistant": True}  # whether it is OpenCV's fisheye model
IDENTITY = np.eye(4)
LONGEST = 300_000  # characters: a camera takes 600, and the parser a second for 100 000


class _Loader(yaml.SafeLoader):
    """Without aliases, which kalibr never writes and which make millions of values of a few lines."""

    def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias")
        return super().compose_node(parent, index)  # pyright: ignore[reportArgumentType]: a node in mappings


def parse(text: str) -> dict[str, dict[str, Any]] | None:
    """The cameras of a camchain; None if the text is none."""
    if "camera_model" not in text or len(text) > LONGEST:
        return None
    try:
        data = yaml.load(text, Loader=_Loader)
    except (
        yaml.YAMLError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        OverflowError,
    ):  # by the value
        return None
    if not isinstance(data, dict):
        return None
    cameras = {str(k): v for k, v in data.items() if isinstance(v, dict) and "camera_model" in v}
    return {key: cameras[key] for key in sorted(cameras, key=natural_key)} or None


def read_kalibr(path: Path, cameras: Mapping[str, Mapping[str, Any]]) -> FoundCalibration:
    """A chain of cameras; alone a camera has no pose."""
    names, out = _names(cameras), {}
    cam_from_world = IDENTITY
    for n, (key, camera) in enumerate(cameras.items()):
        where = f"{path}: {key}"
        if camera["camera_model"] != "pinhole":
            wrong = f"{where}: camera_model is {camera['camera_model']!r}"
            raise InputError("lens-unread", f"{wrong}; expected pinhole; calibrate with pinhole-radtan")
        lens = str(camera.get("distortion_model"))
        if lens not in LENSES:
            text = f"{where}: distortion_model is {lens!r}; expected {', '.join(LENSES)}"
            raise InputError("lens-unread", text)
        if n > 0:
            step = numbers(camera.get("T_cn_cnm1"), (4, 4), f"{where}: T_cn_cnm1")
            pose(step[:3, :3], step[:3, 3], f"{where}: T_cn_cnm1")
            cam_from_world = step @ cam_from_world
        stated = {"distortion_coeffs": []} if lens == "none" else camera
        out[names[key]] = FoundCamera(
            focal_matrix(camera.get("intrinsics"), f"{where}: intrinsics"),
            distortion_of(stated, ["distortion_coeffs"], where, LENSES[lens]),
            "OPENCV_FISHEYE" if LENSES[lens] else "OPENCV",
            size_of(camera.get("resolution"), f"{where}: resolution"),
            cam_from_world[:3] if len(cameras) > 1 else None,
        )
    return FoundCalibration(FORMAT, out, "m")


def _names(cameras: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Key -> name: the first part of the topic where each camera has its own, else the key."""
    topics = {
        key: str(camera.get("rostopic", "")).strip("/").split("/")[0] for key, camera in cameras.items()
    }
    own = all(topics.values()) and len(set(topics.values())) == len(topics)
    return topics if own else {key: key for key in cameras}
