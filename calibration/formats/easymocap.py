"""EasyMocap's pair intri.yml and extri.yml (OpenCV's FileStorage).

intri.yml: `names`, and of each camera K_<name>, dist_<name> (older: D_<name>), H_<name> and W_<name> where written.
extri.yml: R_<name> (rotation vector), Rot_<name> (matrix), T_<name>; x_cam = R x_world + T, metres by their rule.
"""

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
    text_of,
)
from devrf.calibration.formats.opencv import storage
from devrf.capture.system.errors import InputError

FORMAT = "EasyMocap"
INTRI, EXTRI = "intri.yml", "extri.yml"


def is_easymocap(data: Mapping[str, Any]) -> bool:
    """Whether a file of OpenCV's is one of EasyMocap's two."""
    names = data.get("names")
    prefixes = ("K_", "Rot_", "R_")
    return isinstance(names, list) and any(key.startswith(prefixes) for key in data)


def read_easymocap(path: Path, data: Mapping[str, Any]) -> FoundCalibration:
    """The pair; `path` is either of its files."""
    intri, extri = dict(data), dict(data)
    if not any(key.startswith("K_") for key in data):
        intri = _other(path, INTRI, required=True)
    elif not any(key.startswith(("R_", "Rot_")) for key in data):
        extri = _other(path, EXTRI, required=False)
    names, cameras = intri.get("names"), {}
    if not isinstance(names, list):
        text = f"{path.parent / INTRI}: names is {names!r}; expected a list of the cameras' names"
        raise InputError("entry-wrong", text)
    for name in map(str, names):
        where = f"{path.parent / INTRI}"
        width, height = intri.get(f"W_{name}"), intri.get(f"H_{name}")
        has_size = width not in (None, -1) and height not in (None, -1)  # -1: not known
        size = size_of([width, height], f"{where}: W_{name}, H_{name}") if has_size else None
        K = matrix(intri.get(f"K_{name}"), f"{where}: K_{name}")
        k = distortion_of(intri, [f"dist_{name}", f"D_{name}"], where, others=())
        cam_from_world = None
        if extri:
            rotation = extri.get(f"Rot_{name}", extri.get(f"R_{name}"))
            cam_from_world = pose(rotation, extri.get(f"T_{name}"), f"{path.parent / EXTRI}: camera {name}")
        cameras[name] = FoundCamera(K, k, "OPENCV", size, cam_from_world)
    return FoundCalibration(FORMAT, cameras, "m")


def _other(path: Path, name: str, required: bool) -> dict[str, Any]:
    other = path.with_name(name)
    found = storage(text_of(other)) if other.is_file() else None
    if found is None and required:
        text = f"{path}: has poses, but no K_ of any camera; expected {name} beside it; copy it there"
        raise InputError("file-missing", text)
    return found or {}
