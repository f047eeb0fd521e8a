"""What a calibration file of another tool says, in our conventions, and the checks that every reader shares.

K has the centre of the top-left pixel at (0.5, 0.5); OpenCV, and with it every tool but COLMAP, counts it as (0, 0).
Distortion is OpenCV's k1, k2, p1, p2, k3 (`OPENCV`) or k1, k2, k3, k4, 0 of the angle (`OPENCV_FISHEYE`).
`where` in every check names the file and the key, for messages.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from devrf.calibration.intrinsics import HALF_PIXEL
from devrf.capture.camera import RIGID_TOLERANCE, Camera, LensModel
from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import is_device

Unit = Literal["m", "cm", "mm", "arbitrary", "unsaid"]
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
LARGEST_BYTES = 10_000_000  # a calibration is kilobytes; a clip named by mistake is not read
DEEPEST = 200  # levels; OpenCV's own parser, which is native code, falls at thousands
LENGTHS = (0, 4, 5, 8, 12, 14)  # of OpenCV's distortion vectors
FISHEYE_LENGTH = 4
OTHER_NAMES = (  # of one list of coefficients, by other programs
    *(
        "distortion_coefficients",
        "Distortion_Coefficients",
        "distortion_coeffs",
        "distortion_coefs",
        "distortion",
    ),
    *("distortions", "dist_coeffs", "dist_coeff", "dist"),
)
HELD = 5  # coefficients that our lens model has
LARGEST_SKEW = 1e-6  # of the focal length: less turns no pixel of any picture by a thousandth of a pixel


@dataclass(frozen=True)
class FoundCamera:
    """One camera of a file.

    Attributes:
        K: Intrinsics [3, 3], pixels, our half pixel.
        distortion: k1, k2, p1, p2, k3 [5]; of a fisheye lens k1, k2, k3, k4, 0.
        model: The lens model.
        size: Width and height, pixels; None where the format has none.
        cam_from_world: [3, 4] in the file's unit; None where the file has intrinsics only.
    """

    K: Float[np.ndarray, "3 3"]
    distortion: Float[np.ndarray, "5"]
    model: LensModel = "OPENCV"
    size: tuple[int, int] | None = None
    cam_from_world: Float[np.ndarray, "3 4"] | None = None


@dataclass(frozen=True)
class FoundCalibration:
    """All cameras of a calibration, in the order of the file.

    Attributes:
        format: The format in words, for messages.
        cameras: By the name that the file gives.
        unit: Of lengths; `unsaid` where the format leaves it to its user.
        notes: What was left out or assumed, in words.
    """

    format: str
    cameras: dict[str, FoundCamera]
    unit: Unit
    notes: tuple[str, ...] = ()


def text_of(path: Path) -> str:
    """Content of a text file.

    Raises:
        InputError: Too large, not text, or cannot be read.
    """
    try:
        if is_device(path):
            raise InputError("file-is-device", f"{path}: is a device or a pipe; expected a calibration file")
        if path.stat().st_size > LARGEST_BYTES:
            text = f"{path}: has {path.stat().st_size / 1e6:.0f} MB; expected a calibration file"
            raise InputError("file-too-large", text)
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        wrong = f"{path}: not UTF-8 text; expected a calibration file"
        raise InputError("encoding-wrong", f"{wrong}; save it as UTF-8 (UTF-16 is not read)") from None
    except OSError as error:
        wrong = f"{path}: cannot be read ({error.strerror}); check calibration.rig.given"
        raise InputError("file-unreadable", wrong) from None
    if nesting(text) > DEEPEST:
        raise InputError("file-damaged", f"{path}: nested {nesting(text)} deep; expected a calibration file")
    return text


def nesting(text: str) -> int:
    """How deep a text can be nested at most, whether it is YAML, TOML, JSON or XML: brackets, indents, tags."""
    steps = {"[": 1, "{": 1, "]": -1, "}": -1, "</": -1, "/>": -1}
    depth = deepest = 0
    for mark in re.findall(r"[\[\]{}]|</|/>|<(?=\w)", text):
        depth = max(0, depth + steps.get(mark, 1))
        deepest = max(deepest, depth)
    return max(deepest, *(len(indent) for indent in re.findall(r"^[ \t?-]*", text, re.MULTILINE)))


def numbers(value: Any, shape: tuple[int, ...], where: str) -> np.ndarray:
    """A value as an array of floats of this shape; singleton axes do not matter.

    Raises:
        InputError: Missing, not numbers, another count of them, or not finite.
    """
    if value is None:
        raise InputError("entry-missing", f"{where} is missing; expected {_shape_words(shape)}")
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        text = f"{where} is {_shorten(value)}; expected {_shape_words(shape)}"
        raise InputError("entry-wrong", text) from None
    squeezed = tuple(n for n in array.shape if n != 1)
    if squeezed != tuple(n for n in shape if n != 1) and array.shape != (int(np.prod(shape)),):
        text = f"{where} has {'x'.join(map(str, array.shape)) or 'one'} number(s); expected {_shape_words(shape)}"
        raise InputError("entry-wrong", text)
    if not np.isfinite(array).all():
        text = f"{where} is {_shorten(array.tolist())}; expected finite numbers; calibrate again"
        raise InputError("entry-wrong", text)
    return array.reshape(shape)


def matrix(value: Any, where: str) -> Float[np.ndarray, "3 3"]:
    """OpenCV's camera matrix as our K.

    Raises:
        InputError: Not a camera matrix without skew.
    """
    K = numbers(value, (3, 3), where)
    fx, skew, fy = K[0, 0], K[0, 1], K[1, 1]
    if min(fx, fy) <= 0 or abs(K[1, 0]) > 0 or not np.allclose(K[2], [0, 0, 1]):
        text = f"{where} is {K.tolist()}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with focal lengths above 0"
        raise InputError("entry-wrong", text)
    if abs(skew) > LARGEST_SKEW * fx:
        raise InputError("lens-unread", f"{where} has skew {skew:g}; expected 0; calibrate without skew")
    return np.array([[fx, 0, K[0, 2]], [0, fy, K[1, 2]], [0, 0, 1]]) + HALF_PIXEL


def focal_matrix(values: Any, where: str) -> Float[np.ndarray, "3 3"]:
    """K of fx, fy, cx, cy in OpenCV's convention."""
    fx, fy, cx, cy = numbers(values, (4,), where)
    return matrix([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], where)


def distortion(value: Any, where: str, fisheye: bool = False) -> Float[np.ndarray, "5"]:
    """OpenCV's distortion vector as ours.

    Raises:
        InputError: A length that OpenCV does not have, or coefficients beyond k3 that are not 0.
    """
    try:
        flat = np.array(value, dtype=np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
        text = f"{where} is {_shorten(value)}; expected distortion coefficients"
        raise InputError("entry-wrong", text) from None
    lengths: Sequence[int] = (0, FISHEYE_LENGTH) if fisheye else LENGTHS
    if flat.size not in lengths or not np.isfinite(flat).all():
        expected = (
            f"{' or '.join(map(str, lengths))} finite numbers{' of the fisheye model' if fisheye else ''}"
        )
        wrong = f"{where} has {flat.size} coefficients ({_shorten(flat.tolist())})"
        raise InputError("entry-wrong", f"{wrong}; expected {expected}")
    beyond = {COEFFICIENTS[n]: flat[n] for n in range(HELD, flat.size) if flat[n] != 0}
    if beyond:
        words = ", ".join(f"{name} = {number:g}" for name, number in beyond.items())
        wrong = f"{where}: {words} cannot be held; expected the lens model k1, k2, p1, p2, k3"
        remedy = "calibrate again without the rational, thin-prism and tilted models"
        raise InputError("lens-unread", f"{wrong}; {remedy}")
    out = np.zeros(HELD)
    out[: flat[:HELD].size] = flat[:HELD]
    return out


def distortion_of(
    camera: Mapping[str, Any],
    keys: Sequence[str],
    where: str,
    fisheye: bool = False,
    others: Sequence[str] = OTHER_NAMES,
) -> Float[np.ndarray, "5"]:
    """A camera's distortion vector as ours, which a file must state: an empty list is a lens without distortion.

    Args:
        camera: What the file says of the camera.
        keys: Under which its format has the vector.
        where: The camera, for messages.
        fisheye: Whether it is OpenCV's fisheye model.
        others: Where there is none of `keys`, the only one of these counts.
    Raises:
        InputError: No vector, several under other names, or one as of `distortion`.
    """
    stated = [key for key in keys if camera.get(key) is not None][:1]
    stated = stated or [key for key in others if camera.get(key) is not None]
    if len(stated) != 1:
        has = ", ".join(stated or [str(key) for key in camera])
        wrong = f"{where}: has no {keys[0]}; it has {has}"
        remedy = f"rename the one that it is, or write {keys[0]} with an empty list, [], if the lens has none"
        raise InputError("entry-missing", f"{wrong}; expected the lens' distortion; {remedy}")
    return distortion(camera[stated[0]], f"{where}: {stated[0]}", fisheye)


def pose(rotation: Any, translation: Any, where: str) -> Float[np.ndarray, "3 4"]:
    """cam_from_world of a rotation (3x3, or a rotation vector of 3) and a translation.

    Raises:
        InputError: The matrix is not a rotation.
    """
    t = numbers(translation, (3,), f"{where}: translation")
    array = numbers(rotation, (3,) if _holds(rotation, 3) else (3, 3), f"{where}: rotation")
    if array.shape == (3,):
        R = Rotation.from_rotvec(array).as_matrix()
        if not np.isfinite(R).all():
            text = f"{where}: rotation is {array.tolist()}; expected a rotation vector, radians"
            raise InputError("entry-wrong", text)
    else:
        R = array
        off = float(np.abs(R @ R.T - np.eye(3)).max())
        if off > RIGID_TOLERANCE or np.linalg.det(R) < 0:
            found = f"R R^T differs from 1 by {off:.2g}, determinant {np.linalg.det(R):.3g}"
            remedy = (
                "expected an orthonormal matrix with determinant 1; is the file cut or are its axes mirrored?"
            )
            raise InputError("pose-not-rigid", f"{where}: rotation is no rotation ({found}); {remedy}")
    return np.column_stack([R, t])


def cv_coefficients(camera: Camera) -> list[float]:
    """A camera's distortion as OpenCV's vector: five coefficients, four of a fisheye lens."""
    return camera.distortion[: FISHEYE_LENGTH if camera.model == "OPENCV_FISHEYE" else HELD].tolist()


def size_of(pair: Any, where: str) -> tuple[int, int]:
    """Width and height in pixels.

    Raises:
        InputError: Not two whole numbers above 0.
    """
    w, h = numbers(pair, (2,), where).tolist()
    if w < 1 or h < 1 or w != round(w) or h != round(h):
        raise InputError("entry-wrong", f"{where} is {w:g}x{h:g}; expected width and height in pixels")
    return int(w), int(h)


def _holds(value: Any, count: int) -> bool:
    try:
        return np.array(value, dtype=np.float64).size == count
    except (TypeError, ValueError, OverflowError):
        return False


def _shape_words(shape: tuple[int, ...]) -> str:
    return f"{'x'.join(map(str, shape))} numbers"


def _shorten(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
