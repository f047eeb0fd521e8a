"""COLMAP's sparse models, read and written without COLMAP: cameras, images and points3D, `.bin` or `.txt`.

Layout: COLMAP documentation, "Output format". Binary files are little endian and begin with a uint64 count:
- camera: int32 id, int32 model, uint64 width, uint64 height, then the model's parameters as float64
- image: int32 id, float64 qw qx qy qz tx ty tz (world-to-camera, OpenCV's axes), int32 camera id, name ended by
  a zero byte, uint64 count of keypoints, each float64 x, y and int64 point id (-1: none)
- point: uint64 id, float64 x y z, uint8 r g b, float64 error, uint64 length of its track, each int32 image id
  and int32 keypoint
Pixel (0, 0) has its centre at (0.5, 0.5), as everywhere here.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from devrf.capture.formats.parts.files import read_text
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.limits import MODEL_BYTES, check_bytes

MODELS = (  # name and number of parameters, by COLMAP's number of the model
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)
MODEL_NUMBER = {name: number for number, (name, _) in enumerate(MODELS)}
UNKNOWN_ERROR_PX = -1.0  # COLMAP's own mark for a reprojection error that was not computed
GREY = 128
KEYPOINT = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
SEEN = np.dtype([("image", "<i4"), ("keypoint", "<i4")])


class _UnknownLens(Exception):
    """A lens model that COLMAP has and we do not know."""


@dataclass(frozen=True)
class ModelCamera:
    """Intrinsics: name of the model, size, parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered picture: its name, camera's id, pose and keypoints.

    Attributes:
        name: Relative to the folder of pictures.
        camera_id: Its camera.
        quat_wxyz: Rotation of cam_from_world [4].
        translation: Of cam_from_world [3].
        keypoints: x, y of keypoints [k, 2], pixels.
        points: Of each keypoint the id of its point, or -1 [k].
    """

    name: str
    camera_id: int
    quat_wxyz: Float[np.ndarray, "4"]
    translation: Float[np.ndarray, "3"]
    keypoints: Float[np.ndarray, "k 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    points: Int[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class ModelPoint:
    """A point: position [3], reprojection error in pixels (below 0: unknown), ids of the images that show it, sRGB."""

    xyz: Float[np.ndarray, "3"]
    error_px: float
    images: Int[np.ndarray, " seen"]
    rgb: tuple[int, int, int] = (GREY, GREY, GREY)


@dataclass(frozen=True)
class Model:
    """A sparse model; everything by its id."""

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    points: dict[int, ModelPoint]


def read_model(folder: Path) -> Model:
    """Read a model in either form; binary files are preferred. Without points3D there are no points.

    Raises:
        CaptureError: A file is missing or damaged, or a lens model is not one of `MODELS`.
    """
    points = read_points(folder) if _file(folder, "points3D").is_file() else {}
    return Model(_part(folder, "cameras"), _part(folder, "images"), points)


def read_points(folder: Path) -> dict[int, ModelPoint]:
    """The points of a model alone; errors as of `read_model`."""
    return _part(folder, "points3D")


def is_model(folder: Path) -> bool:
    """Whether a folder holds a model, in either form."""
    return _file(folder, "cameras").is_file()


def count_images(folder: Path) -> int:
    """How many pictures a model has, without its keypoints where it is binary.

    Raises:
        CaptureError: As of `read_model`.
    """
    path = _file(folder, "images")
    if path.suffix == ".bin":
        with path.open("rb") as file:
            head = file.read(8)
        if len(head) == 8:
            return struct.unpack("<Q", head)[0]
    return len(_part(folder, "images"))


def _file(folder: Path, name: str) -> Path:
    path = folder / f"{name}.bin"
    return path if path.is_file() else folder / f"{name}.txt"


def _part(folder: Path, name: str) -> dict:
    path, (binary, text) = _file(folder, name), PARTS[name]
    if not path.is_file():
        wrong = f"{folder}: neither {name}.bin nor {name}.txt"
        raise CaptureError("file-missing", f"{wrong}; expected a COLMAP model")
    try:
        if path.suffix == ".txt":
            return text(read_text(path, MODEL_BYTES))
        check_bytes(path, MODEL_BYTES)
        return binary(_Bytes(path.read_bytes()))
    except _UnknownLens as error:
        wrong = f"{path}: {error}, which this program does not know; expected {', '.join(MODEL_NUMBER)}"
        raise CaptureError("lens-unread", f"{wrong}; undistort the pictures with COLMAP first") from None
    except (struct.error, ValueError, IndexError, OSError, KeyError, OverflowError) as error:
        wrong = f"{path}: damaged or cut off ({error}); copy it again, or export it from COLMAP again"
        raise CaptureError("file-damaged", wrong) from None


def write_model(folder: Path, model: Model) -> None:
    """Write a model in binary form."""
    folder.mkdir(parents=True, exist_ok=True)
    rows: list[bytes] = []
    for number, camera in model.cameras.items():
        head = struct.pack("<iiQQ", number, MODEL_NUMBER[camera.model], camera.width, camera.height)
        rows.append(head + struct.pack(f"<{len(camera.params)}d", *camera.params))
    _write(folder / "cameras.bin", rows)
    rows, track = [], {number: [] for number in model.points}
    for number, image in model.images.items():
        head = struct.pack("<i7di", number, *image.quat_wxyz, *image.translation, image.camera_id)
        keypoints = np.zeros(len(image.points), KEYPOINT)
        keypoints["x"], keypoints["y"] = image.keypoints.T
        keypoints["point"] = image.points
        for place, point in enumerate(image.points.tolist()):
            if point >= 0:
                track[point].append((number, place))
        rows.append(
            head + image.name.encode() + b"\0" + struct.pack("<Q", len(keypoints)) + keypoints.tobytes()
        )
    _write(folder / "images.bin", rows)
    rows = []
    for number, point in model.points.items():
        head = struct.pack("<Q3d3Bd", number, *point.xyz, *point.rgb, point.error_px)
        rows.append(head + struct.pack("<Q", len(track[number])) + np.array(track[number], SEEN).tobytes())
    _write(folder / "points3D.bin", rows)


def _write(path: Path, rows: Sequence[bytes]) -> None:
    path.write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))


class _Bytes:
    """A place in the bytes of a file; reading beyond the end is a struct.error."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode()
        self.at = end + 1
        return text

    def array(self, kind: np.dtype, count: int) -> np.ndarray:
        if self.at + kind.itemsize * count > len(self.data):
            raise struct.error(f"{len(self.data)} bytes are fewer than its counts promise")
        out = np.frombuffer(self.data, kind, count, self.at)
        self.at += kind.itemsize * count
        return out

    def each(self, read: Callable[[], tuple[int, object]]) -> dict:
        (count,) = self.take("Q")
        if count > len(self.data):
            raise struct.error(f"{len(self.data)} bytes are fewer than its counts promise")
        return dict(read() for _ in range(count))


def _binary_cameras(data: _Bytes) -> dict[int, ModelCamera]:
    def camera() -> tuple[int, ModelCamera]:
        number, model, width, height = data.take("iiQQ")
        if not 0 <= model < len(MODELS):
            raise _UnknownLens(f"camera {number} has the lens model of number {model}")
        name, count = MODELS[model]
        return number, ModelCamera(name, width, height, data.take(f"{count}d"))

    return data.each(camera)


def _binary_images(data: _Bytes) -> dict[int, ModelImage]:
    def image() -> tuple[int, ModelImage]:
        number, *pose, camera_id = data.take("i7di")
        name = data.name()
        keypoints = data.array(KEYPOINT, data.take("Q")[0])
        xy = np.stack([keypoints["x"], keypoints["y"]], axis=-1)
        points = keypoints["point"].astype(np.int64)
        return number, ModelImage(name, camera_id, np.array(pose[:4]), np.array(pose[4:]), xy, points)

    return data.each(image)


def _binary_points(data: _Bytes) -> dict[int, ModelPoint]:
    def point() -> tuple[int, ModelPoint]:
        number, x, y, z, red, green, blue, error, length = data.take("Q3d3BdQ")
        images = data.array(SEEN, length)["image"].astype(np.int64)
        return number, ModelPoint(np.array([x, y, z]), error, images, (red, green, blue))

    return data.each(point)


def _lines(text: str) -> list[str]:
    return [line.strip() for line in text.splitlines() if not line.lstrip().startswith("#")]


def _text_cameras(text: str) -> dict[int, ModelCamera]:
    out = {}
    for line in filter(None, _lines(text)):
        number, model, width, height, *params = line.split()
        if model not in MODEL_NUMBER:
            raise _UnknownLens(f"camera {number} has the lens model {model}")
        if len(params) != (count := MODELS[MODEL_NUMBER[model]][1]):
            raise ValueError(f"camera {number}: {model} with {len(params)} parameters, expected {count}")
        out[int(number)] = ModelCamera(model, int(width), int(height), tuple(map(float, params)))
    return out


def _text_images(text: str) -> dict[int, ModelImage]:
    """Two lines per image; the second, of keypoints, is empty or missing where it has none.

    Other empty lines mean nothing. A line of numbers in threes is keypoints; one that begins an image has its name.
    """
    out, lines = {}, _lines(text)
    at = 0
    while at < len(lines):
        head, at = lines[at].split(maxsplit=9), at + 1
        if not head:
            continue
        if len(head) < 10:
            wrong = f"'{_shown(lines[at - 1])}' is neither an image nor its keypoints"
            why = f"{wrong}: each image has two lines, of id, 7 numbers of a pose, camera, name; of x, y, id"
            raise ValueError(why)
        values = _keypoints(lines[at]) if at < len(lines) else None
        at += values is not None
        values = np.zeros((0, 3)) if values is None else values
        pose, points = np.array(head[1:8], dtype=np.float64), values[:, 2].astype(np.int64)
        out[int(head[0])] = ModelImage(head[9], int(head[8]), pose[:4], pose[4:], values[:, :2], points)
    return out


def _keypoints(line: str) -> np.ndarray | None:
    """x, y and point of keypoints [k, 3]; None where the line has none and is another image's."""
    try:
        return np.array(line.split(), dtype=np.float64).reshape(-1, 3)
    except ValueError:
        return None


def _shown(line: str) -> str:
    return line if len(line) <= 60 else line[:57] + "..."


def _text_points(text: str) -> dict[int, ModelPoint]:
    out = {}
    for line in filter(None, _lines(text)):
        number, x, y, z, red, green, blue, error, *track = line.split()
        xyz, images = np.array([x, y, z], dtype=np.float64), np.array(track[::2], dtype=np.int64)
        out[int(number)] = ModelPoint(xyz, float(error), images, (int(red), int(green), int(blue)))
    return out


PARTS = {  # readers of the binary and of the text file
    "cameras": (_binary_cameras, _text_cameras),
    "images": (_binary_images, _text_images),
    "points3D": (_binary_points, _text_points),
}
