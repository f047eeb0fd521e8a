"""Rigs in the layouts of other tools: those that are exported by our writers, the others by hand."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np
import yaml

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.intrinsics import HALF_PIXEL
from devrf.capture.camera import Camera

Cameras = Mapping[str, Camera]


def _vector(camera: Camera) -> np.ndarray:
    return cv2.Rodrigues(camera.cam_from_world[:, :3])[0]


def _toml(path: Path, cameras: Cameras, always_fisheye: bool) -> None:
    lines = []
    for n, (name, camera) in enumerate(cameras.items()):
        fisheye = camera.model == "OPENCV_FISHEYE"
        lines += [
            f"[cam_{n}]",
            f"name = {json.dumps(name)}",
            f"size = [{camera.width}, {camera.height}]",
            f"matrix = {(camera.K - HALF_PIXEL).tolist()}",
            f"distortions = {camera.distortion[: 4 if fisheye else 5].tolist()}",
            f"rotation = {_vector(camera).ravel().tolist()}",
            f"translation = {camera.cam_from_world[:, 3].tolist()}",
            f"fisheye = {json.dumps(fisheye)}" if always_fisheye or fisheye else "",
        ]
    path.write_text("\n".join([*lines, "[metadata]", "adjusted = false", "error = 0.0", ""]))


def _anipose(folder: Path, cameras: Cameras, metric: bool) -> None:
    """Of aniposelib, which says `fisheye` only of fisheye lenses."""
    _toml(folder / "calibration.toml", cameras, always_fisheye=False)


def _pose2sim(folder: Path, cameras: Cameras, metric: bool) -> None:
    _toml(folder / "Calib.toml", cameras, always_fisheye=True)


def _easymocap(folder: Path, cameras: Cameras, metric: bool) -> None:
    files = [cv2.FileStorage(str(folder / f"{n}.yml"), cv2.FILE_STORAGE_WRITE) for n in ("intri", "extri")]
    intri, extri = files
    for file in files:
        file.startWriteStruct("names", cv2.FILE_NODE_SEQ)
        for name in cameras:
            file.write("", name)
        file.endWriteStruct()
    for name, camera in cameras.items():
        intri.write(f"K_{name}", camera.K - HALF_PIXEL)
        intri.write(f"dist_{name}", camera.distortion[None])
        intri.write(f"H_{name}", camera.height)
        intri.write(f"W_{name}", camera.width)
        extri.write(f"R_{name}", _vector(camera))
        extri.write(f"Rot_{name}", np.ascontiguousarray(camera.cam_from_world[:, :3]))
        extri.write(f"T_{name}", camera.cam_from_world[:, 3:].copy())
    for file in files:
        file.release()


def _kalibr(folder: Path, cameras: Cameras, metric: bool) -> None:
    """A chain whose world is its first camera; its lenses have four coefficients."""
    out, before = {}, np.eye(4)
    for n, (name, camera) in enumerate(cameras.items()):
        K, cam_from_world = camera.K - HALF_PIXEL, np.vstack([camera.cam_from_world, [0, 0, 0, 1.0]])
        out[f"cam{n}"] = {
            "camera_model": "pinhole",
            "intrinsics": [float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])],
            "distortion_model": "equidistant" if camera.model == "OPENCV_FISHEYE" else "radtan",
            "distortion_coeffs": camera.distortion[:4].tolist(),
            "resolution": [camera.width, camera.height],
            "rostopic": f"/{name}/image_raw",
            **({"T_cn_cnm1": (cam_from_world @ np.linalg.inv(before)).tolist()} if n else {}),
        }
        before = cam_from_world
    (folder / "camchain.yaml").write_text(yaml.safe_dump(out, sort_keys=False))


def _panoptic(folder: Path, cameras: Cameras, metric: bool) -> None:
    """A list, in centimetres."""
    listed = [
        {
            "name": name,
            "type": "hd",
            "resolution": [camera.width, camera.height],
            "K": (camera.K - HALF_PIXEL).tolist(),
            "distCoef": camera.distortion.tolist(),
            "R": camera.cam_from_world[:, :3].tolist(),
            "t": (100 * camera.cam_from_world[:, 3:]).tolist(),
        }
        for name, camera in cameras.items()
    ]
    (folder / "calibration_171204.json").write_text(json.dumps({"calibDataSource": "x", "cameras": listed}))


def _multical(folder: Path, cameras: Cameras, metric: bool) -> None:
    """Lenses and poses apart, poses called by the first camera too."""
    first = next(iter(cameras))
    lenses = {
        name: {
            "model": "fisheye" if camera.model == "OPENCV_FISHEYE" else "standard",
            "image_size": [camera.width, camera.height],
            "K": (camera.K - HALF_PIXEL).tolist(),
            "dist": [camera.distortion[: 4 if camera.model == "OPENCV_FISHEYE" else 5].tolist()],
        }
        for name, camera in cameras.items()
    }
    poses = {
        name if name == first else f"{name}_to_{first}": {
            "R": camera.cam_from_world[:, :3].tolist(),
            "T": camera.cam_from_world[:, 3].tolist(),
        }
        for name, camera in cameras.items()
    }
    (folder / "calibration.json").write_text(json.dumps({"cameras": lenses, "camera_poses": poses}))


RIG_LAYOUTS: dict[str, Callable[[Path, Cameras, bool], None]] = {
    **RIG_WRITERS,
    "anipose": _anipose,
    "easymocap": _easymocap,
    "kalibr": _kalibr,
    "multical": _multical,
    "panoptic": _panoptic,
    "pose2sim": _pose2sim,
}
"""(folder, cameras by name, whether lengths are metres)."""
