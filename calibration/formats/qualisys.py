"""Qualisys Track Manager's calibration (`.qca.txt`, XML), in. The format is not public: it is not written.

What the numbers mean was found on the capture `pose2sim_single`, whose photos show a rail of known length:
- lengths are millimetres; `transform` x, y, z is the camera's position in the world;
- rows of r11..r33 are the camera's axes in the world, with y up and z back: cam_from_world = diag(1, -1, -1) r;
- focal lengths, centre and sensor are in 1/64 pixel and count from the centre of the first pixel (the sensor of 1088
  pixels ends at 1087); the distortion is OpenCV's and without unit (dividing it by 64 too, as Pose2Sim does, fits
  chessboards in three of four cameras worse);
- the film is the part `fov_video` of the sensor.
"""

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from devrf.calibration.formats.found import FoundCalibration, FoundCamera, distortion, matrix, pose, size_of
from devrf.capture.system.errors import InputError

FORMAT = "Qualisys"
SUBPIXELS = 64
MM_PER_M = 1000
OPENCV_FROM_QUALISYS = np.diag([1.0, -1.0, -1.0])


def parse(text: str) -> ElementTree.Element | None:
    """The root of a Qualisys calibration; None if the text is none."""
    if "<!DOCTYPE" in text:  # entities can stand for gigabytes; QTM writes none
        return None
    try:
        root = ElementTree.fromstring(text.encode())
    except (ElementTree.ParseError, LookupError):  # LookupError: an encoding that does not exist
        return None
    return root if root.tag == "calibration" and root.find("cameras/camera") is not None else None


def read_qualisys(path: Path, root: ElementTree.Element) -> FoundCalibration:
    """Video cameras by serial number, in metres."""
    cameras, notes = {}, []
    for number, camera in enumerate(root.iterfind("cameras/camera")):
        name = camera.get("serial") or str(number)
        where = f"{path}: camera {name}"
        if camera.get("active") == "0":
            notes.append(f"camera {name} is left out: the file says it is not active")
            continue
        film = _values(camera, "fov_video", ("left", "top", "right", "bottom"), where)
        axes = [f"r{row}{column}" for row in "123" for column in "123"]
        placed = _values(camera, "transform", ("x", "y", "z", *axes), where)
        lens = _values(
            camera,
            "intrinsic",
            ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew"),
            where,
        )
        k = _values(
            camera,
            "intrinsic",
            (
                "radialDistortion1",
                "radialDistortion2",
                "tangentalDistortion1",
                "tangentalDistortion2",
                "radialDistortion3",
            ),
            where,
        )
        fx, fy, cx, cy, skew = (value / SUBPIXELS for value in lens)
        left, top, right, bottom = film
        centre = np.array(placed[:3]) / MM_PER_M
        R = OPENCV_FROM_QUALISYS @ np.reshape(placed[3:], (3, 3))
        cameras[name] = FoundCamera(
            matrix([[fx, skew, cx - left], [0, fy, cy - top], [0, 0, 1]], f"{where}: intrinsic"),
            distortion(k, f"{where}: intrinsic"),
            "OPENCV",
            size_of([right - left + 1, bottom - top + 1], f"{where}: fov_video"),
            pose(R, -R @ centre, f"{where}: transform"),
        )
    return FoundCalibration(FORMAT, cameras, "m", tuple(notes))


def _values(camera: ElementTree.Element, tag: str, keys: tuple[str, ...], where: str) -> list[float]:
    node = camera.find(tag)
    attributes: Mapping[str, str] = {} if node is None else node.attrib
    out = []
    for key in keys:
        text = attributes.get(key, "0" if key == "skew" else None)
        try:
            out.append(float(text if text is not None else "missing"))
        except ValueError:
            wrong = (
                f"{where}: {tag}.{key} is {text!r}; expected a number; export the calibration from QTM again"
            )
            raise InputError("entry-wrong", wrong) from None
    return out
