"""nerfstudio's `camera_path.json`: the pictures of a film, or its key frames, as nerfstudio's viewer writes them.

`camera_path` is a list of pictures, each with `camera_to_world` (16 numbers, row by row; OpenGL axes: x right, y up,
z back) and `fov` (of the picture's height, degrees); `keyframes` is a list with `matrix` and `fov`, used where there
is no `camera_path`. Beside them stand `fps`, `seconds`, `render_width`, `render_height`, `is_cycle`. `render_time` (or
`time`) of a picture is its time in [0, 1]. Positions are in the world of the data set. nerfstudio turns, shifts and
scales a data set when it trains and writes paths in that frame of its own; its `dataparser_transforms.json`, laid
beside the file, says how and is undone here.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.formats.parts.files import number, number_or_none, read_json
from devrf.capture.formats.parts.opengl import cam_from_opengl
from devrf.capture.system.errors import CaptureError, InputError

DATAPARSER = "dataparser_transforms.json"
MOST_PICTURES = 100_000


@dataclass(frozen=True)
class CameraPath:
    """A path of a file.

    Attributes:
        cameras: In the world of the data set.
        times: Of each in [0, 1]; None where the file names none.
        fps, seconds: As the file says, if it does.
        every_picture: The cameras are the pictures; else key frames, between which a path is to be found.
        closed: The path leads back to its first key frame.
    """

    cameras: tuple[Camera, ...]
    times: tuple[float, ...] | None
    fps: float | None
    seconds: float | None
    every_picture: bool
    closed: bool


def read_camera_path(path: Path, size: tuple[int, int] | None, usual: tuple[int, int]) -> CameraPath:
    """Read such a file.

    Args:
        path: The file.
        size: Width and height that pictures are to have; None: as the file says, else `usual`.
        usual: Where neither says.
    Raises:
        InputError: The file is missing, damaged, or holds no path of perspective cameras.
    """
    try:
        meta = read_json(path)
        undo = _undone(path.with_name(DATAPARSER))
        kind = str(meta.get("camera_type", "perspective")).lower()
        if kind != "perspective":
            text = f"{path}: camera_type is {kind}; only perspective cameras are filmed"
            raise InputError("lens-unread", text)
        every_picture = bool(meta.get("camera_path"))
        entries = meta.get("camera_path") or meta.get("keyframes")
        if not isinstance(entries, list) or not 0 < len(entries) <= MOST_PICTURES:
            wrong = f"{path}: neither camera_path nor keyframes lists any picture"
            remedy = "export a camera path from nerfstudio's viewer, or see docs/film.md for what such a file holds"
            raise InputError("pictures-none", f"{wrong}; {remedy}")
        width, height = size or _size(meta, path) or usual
        cameras, times = [], []
        for n, entry in enumerate(entries):
            where = f"{path}: {'camera_path' if every_picture else 'keyframes'}[{n}]"
            if not isinstance(entry, dict):
                text = f"{where}: is {str(entry)[:60]}; expected camera_to_world and fov"
                raise InputError("entry-wrong", text)
            fov = number(entry.get("fov", meta.get("default_fov", 50.0)), "fov", where)
            if not 0 < fov < 180:
                why = f"{where}: fov is {fov:g}; expected degrees between 0 and 180"
                raise InputError("entry-wrong", why)
            f = 0.5 * height / np.tan(0.5 * np.radians(fov))
            K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
            pose = undo(_matrix(entry.get("camera_to_world", entry.get("matrix")), where))
            cameras.append(Camera(width, height, K, cam_from_opengl(pose, where)))
            times.append(_time(entry, where))
        fps, seconds = (number_or_none(meta, key, str(path)) for key in ("fps", "seconds"))
    except CaptureError as error:
        raise InputError(error.code, str(error)) from None
    if any(time is None for time in times) and any(time is not None for time in times):
        text = f"{path}: some pictures have a render_time and others have none; give all of them one, or none"
        raise InputError("entry-missing", text)
    known = tuple(time for time in times if time is not None)
    closed = bool(meta.get("is_cycle")) and not every_picture
    return CameraPath(tuple(cameras), known or None, fps, seconds, every_picture, closed)


def _matrix(value: Any, where: str) -> Float[np.ndarray, "4 4"]:
    """A pose of 16 numbers, row by row; older viewers wrote key frames as text, column by column."""
    try:
        pose = np.array(json.loads(value) if isinstance(value, str) else value, dtype=np.float64)
        pose = pose.reshape(4, 4)
    except (TypeError, ValueError):
        text = f"{where}: camera_to_world is {str(value)[:60]}; expected 16 numbers"
        raise InputError("entry-wrong", text) from None
    return pose.T if np.any(pose[3, :3]) and not np.any(pose[:3, 3]) else pose


def _undone(path: Path) -> Any:
    """What takes poses of nerfstudio's frame back to the data set's world; nothing without its file."""
    if not path.is_file():
        return lambda pose: pose
    meta = read_json(path)
    try:
        transform, scale = np.array(meta["transform"], dtype=np.float64), float(meta["scale"])
        full = np.vstack([transform.reshape(3, 4), [0, 0, 0, 1]])
        inverse = np.linalg.inv(full)
        if not (scale > 0 and np.isfinite(inverse).all()):
            raise ValueError(f"scale is {scale}")
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
        text = f"{path}: cannot be used ({error}); expected transform (3 rows of 4) and scale"
        raise InputError("file-damaged", text) from None

    def undo(pose: np.ndarray) -> np.ndarray:
        moved = pose.copy()
        moved[:3, 3] /= scale
        return inverse @ moved

    return undo


def _size(meta: dict[str, Any], path: Path) -> tuple[int, int] | None:
    width, height = meta.get("render_width"), meta.get("render_height")
    if width is None or height is None:
        return None
    return int(number(width, "render_width", str(path))), int(number(height, "render_height", str(path)))


def _time(entry: dict[str, Any], where: str) -> float | None:
    value = entry.get("render_time", entry.get("time"))
    if value is None:
        return None
    time = number(value, "render_time", where)
    if not 0 <= time <= 1:
        text = f"{where}: render_time is {time:g}, outside the clip; expected 0 to 1"
        raise InputError("entry-wrong", text)
    return time
