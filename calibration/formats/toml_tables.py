"""Calibrations in TOML: a table a camera with matrix, distortions, rotation and translation.

- caliscope (and pyxy3d before it): [cameras.0] or [cam_0] with `cam_id`; rotation is a matrix or a vector; metres.
- aniposelib, anipose, freemocap: [cam_0] with `name`, rotation vector; lengths in the unit of the board.
- Pose2Sim: as aniposelib, with `fisheye` in every table; metres. aniposelib says `fisheye` only of fisheye lenses, so
  where all are, either may have written it and the unit is not known.

x_cam = R x_world + t, pixels count from the centre of the first one. Written are those of caliscope.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from devrf.calibration.formats.found import (
    FoundCalibration,
    FoundCamera,
    Unit,
    cv_coefficients,
    distortion_of,
    matrix,
    pose,
    size_of,
)
from devrf.calibration.intrinsics import HALF_PIXEL
from devrf.capture.camera import Camera

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

Flavour = Literal["caliscope", "aniposelib", "Pose2Sim"]
UNITS: dict[Flavour, Unit] = {"caliscope": "m", "aniposelib": "unsaid", "Pose2Sim": "m"}


def parse(text: str) -> dict[str, dict[str, Any]] | None:
    """The tables of cameras; None if the text has none."""
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError):  # of syntax; of a number with thousands of digits
        return None
    inner = data.get("cameras")
    tables = inner if isinstance(inner, dict) else data
    cameras = {key: value for key, value in tables.items() if isinstance(value, dict) and "matrix" in value}
    return cameras or None


def read_toml(path: Path, tables: Mapping[str, Mapping[str, Any]]) -> FoundCalibration:
    """Cameras that their tool did not set aside (`ignore`)."""
    flavour: Flavour = "aniposelib"
    if any("cam_id" in table or "port" in table for table in tables.values()):  # port: pyxy3d's word
        flavour = "caliscope"
    elif not all(table.get("fisheye", False) for table in tables.values()) and all(
        "fisheye" in table for table in tables.values()
    ):
        flavour = "Pose2Sim"
    used = {key: table for key, table in tables.items() if not table.get("ignore", False)}
    notes = tuple(f"camera {key} is left out: its file says ignore" for key in tables if key not in used)
    return FoundCalibration(
        flavour, dict(_camera(path, key, table) for key, table in used.items()), UNITS[flavour], notes
    )


def write_caliscope(folder: Path, cameras: Mapping[str, Camera], metric: bool) -> None:
    """camera_array.toml for caliscope, which numbers cameras from 0."""
    lines = []
    for n, (name, camera) in enumerate(cameras.items()):
        lines += [f"# {name}", f"[cameras.{n}]", f"cam_id = {n}", "rotation_count = 0", "ignore = false"]
        R, t = camera.cam_from_world[:, :3], camera.cam_from_world[:, 3]
        lines += [
            f"size = [{camera.width}, {camera.height}]",
            f"matrix = {(camera.K - HALF_PIXEL).tolist()}",
            f"distortions = {cv_coefficients(camera)}",
            f"translation = {t.tolist()}",
            f"rotation = {R.tolist()}",
            f"fisheye = {json.dumps(camera.model == 'OPENCV_FISHEYE')}",
            "",
        ]
    (folder / "camera_array.toml").write_text("\n".join(lines))


def _camera(path: Path, key: str, table: Mapping[str, Any]) -> tuple[str, FoundCamera]:
    where = f"{path}: [{key}]"
    fisheye = bool(table.get("fisheye", False))
    size = table.get("size")
    if size is not None:
        size = size_of(size, f"{where}: size")
    cam_from_world = None
    if table.get("rotation") is not None and table.get("translation") is not None:
        cam_from_world = pose(table["rotation"], table["translation"], where)
    camera = FoundCamera(
        matrix(table["matrix"], f"{where}: matrix"),
        distortion_of(table, ["distortions"], where, fisheye),
        "OPENCV_FISHEYE" if fisheye else "OPENCV",
        size,
        cam_from_world,
    )
    return str(table.get("name", key)), camera
