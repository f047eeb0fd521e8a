"""Calibrations of other tools, in and out: which reader a file is for, told by its content; which writers there are."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from devrf.calibration.formats.colmap_rig import is_colmap, read_colmap_rig, write_colmap_rig
from devrf.calibration.formats.easymocap import INTRI, is_easymocap, read_easymocap
from devrf.calibration.formats.found import FoundCalibration, FoundCamera, text_of
from devrf.calibration.formats.json_cameras import parse as parse_json
from devrf.calibration.formats.json_cameras import read_json_cameras
from devrf.calibration.formats.kalibr import parse as parse_kalibr
from devrf.calibration.formats.kalibr import read_kalibr
from devrf.calibration.formats.llff_rig import is_llff, read_llff_rig
from devrf.calibration.formats.opencv import (
    ENDINGS,
    INTRINSICS_FILE,
    is_single,
    is_stereo,
    read_singles,
    read_stereo,
    storage,
    write_opencv,
)
from devrf.calibration.formats.qualisys import parse as parse_qualisys
from devrf.calibration.formats.qualisys import read_qualisys
from devrf.calibration.formats.toml_tables import parse as parse_toml
from devrf.calibration.formats.toml_tables import read_toml, write_caliscope
from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError

__all__ = [
    "READ",
    "RIG_WRITERS",
    "FoundCalibration",
    "FoundCamera",
    "find_calibration",
    "find_single_files",
    "is_json_of_others",
]

READ = (
    "rig.json; a COLMAP model; yml, xml or JSON of OpenCV (one camera, or a stereo pair), ROS or EasyMocap; a kalibr "
    "camchain; toml of caliscope, aniposelib or Pose2Sim; JSON of the Panoptic Studio or multical; Qualisys .qca.txt; "
    "LLFF's poses_bounds.npy"
)
Writer = Callable[[Path, Mapping[str, Camera], bool], None]
RIG_WRITERS: dict[str, Writer] = {  # (folder, cameras by name, whether lengths are metres)
    "rig-caliscope": write_caliscope,
    "rig-colmap": write_colmap_rig,
    "rig-opencv": write_opencv,
}

PARSED: tuple[tuple[Callable[[str], Any], Callable[[Path, Any], FoundCalibration]], ...] = (
    (parse_qualisys, read_qualisys),
    (parse_toml, read_toml),
    (parse_kalibr, read_kalibr),
    (parse_json, read_json_cameras),
)


def find_calibration(path: Path) -> FoundCalibration:
    """Read a calibration of another tool.

    Args:
        path: A file, or a folder: a COLMAP model, EasyMocap's or OpenCV's pair, or OpenCV files, one a camera.
    Raises:
        InputError: None of the formats, or a value in it that cannot be used; says which.
        CaptureError: A damaged COLMAP model.
    """
    if path.is_dir():
        return _from_folder(path)
    if is_llff(path):
        return read_llff_rig(path)
    text = text_of(path)
    for parse, read in PARSED:
        if (content := parse(text)) is not None:
            return read(path, content)
    if (data := storage(text)) is not None:
        if is_easymocap(data):
            return read_easymocap(path, data)
        if is_single(data):
            return read_singles({path.stem: (path, data)})
        if is_stereo(data):
            return read_stereo(path, data)
    raise InputError("calibration-unread", f"{path}: not a calibration that can be read; expected {READ}")


def is_json_of_others(path: Path) -> bool:
    """Whether a JSON file is a calibration of another program."""
    try:
        text = text_of(path)
    except InputError:
        return False
    data = storage(text)
    return parse_json(text) is not None or (data is not None and (is_single(data) or is_stereo(data)))


def find_single_files(files: Mapping[str, Path]) -> FoundCalibration:
    """One OpenCV file a camera.

    Raises:
        InputError: A file is not OpenCV's, or describes no single camera.
    """
    out = {}
    for name, path in files.items():
        data = storage(text_of(path))
        if data is None or not is_single(data):
            wrong = f"{path}: has no camera_matrix; expected OpenCV's file of one camera ('{name}')"
            remedy = "a file with all cameras is named without the camera's name"
            raise InputError("entry-missing", f"{wrong}; {remedy}")
        out[name] = (path, data)
    return read_singles(out)


def _from_folder(folder: Path) -> FoundCalibration:
    if is_colmap(folder):
        return read_colmap_rig(folder)
    for name in (INTRI, INTRINSICS_FILE):
        if (folder / name).is_file():
            return find_calibration(folder / name)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in ENDINGS and path.is_file())
    singles = {}
    for path in files:
        data = storage(text_of(path))
        if data is not None and is_single(data):
            singles[path.stem] = (path, data)
    if not singles:
        expected = (
            "expected a COLMAP model, intri.yml and extri.yml, intrinsics.yml and extrinsics.yml, or OpenCV files, "
            "one a camera"
        )
        text = f"{folder}: no calibration in this folder; {expected}; else name the file itself"
        raise InputError("calibration-unread", text)
    return read_singles(singles)
