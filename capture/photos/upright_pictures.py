"""Photos, upright.

A photo's EXIF orientation is applied once, here; files that need no turn are taken as they are.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image

from devrf.capture.colour.photo_curve import declared_gamma
from devrf.capture.exif import Exif, read_exif, tags_of
from devrf.capture.orientation import by_exif
from devrf.capture.photos.picture_files import JPEG_SUFFIXES, open_picture
from devrf.capture.photos.raw import develop, is_raw, read_layout
from devrf.capture.system.errors import CaptureError

JPEG_QUALITY = 97  # of photos that had to be turned: a second JPEG at this quality costs < 1 level RMS
# Twice as fast as level 1 alone, and smaller (46 against 93 ms, 1.17 against 1.30 MB for 1080x1920).
PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}  # by channels as OpenCV reads


@dataclass(frozen=True)
class PictureInfo:
    """What a photo's header says.

    Attributes:
        path: The file.
        width, height: Size of the upright picture, pixels.
        turned: Whether EXIF asks for a turn or a mirror.
        exif: What its tags say of device, lens and place; None for RAW files.
        gamma: Exponent from its levels to light, where the file names one.
    """

    path: Path
    width: int
    height: int
    turned: bool
    exif: Exif | None
    gamma: float | None = None


def probe_picture(path: Path) -> PictureInfo:
    """Read a photo's header.

    Raises:
        InputError: If the file is not a RAW file.
        CaptureError: If the file is not a picture, or larger than can be read.
    """
    if is_raw(path):
        raw = read_layout(path)
        size = raw.upright.size(raw.width, raw.height)
        return PictureInfo(path, *size, not raw.upright.nothing, None)
    with open_picture(path) as image:
        upright = by_exif(_orientation(image))
        size = upright.size(*image.size)
        return PictureInfo(path, *size, not upright.nothing, read_exif(image), declared_gamma(image))


def read_picture(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """Read a photo upright: RGB, or RGBA where the file has transparency; 16 bits are rounded to 8.

    A RAW file is developed as a set of its own (`capture.raw_set` develops a folder by one recipe).

    Raises:
        InputError: If the file is not a RAW file.
        CaptureError: If it is not a picture, too large, or damaged.
    """
    if is_raw(path):
        return develop(path).rgb
    with open_picture(path) as header:
        orientation = _orientation(header)
    image = _decoded(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        text = f"{path}: the picture does not decode; copy it from the camera again"
        raise CaptureError("picture-unreadable", text)
    if image.dtype == np.uint16:
        image = np.round(image / 257.0).astype(np.uint8)
    if image.dtype != np.uint8:
        raise CaptureError("picture-kind-unread", f"{path}: pixels are {image.dtype}, expected 8 or 16 bits")
    in_order = cv2.cvtColor(image, TO_RGB[image.shape[2] if image.ndim == 3 else 1])
    return np.ascontiguousarray(by_exif(orientation).apply(in_order)).astype(np.uint8, copy=False)


def read_grey(path: Path) -> UInt8[np.ndarray, "height width"]:
    """A frame of a run as grey levels; of a JPEG those that are stored, without its colours.

    Raises:
        CaptureError: It cannot be read.
    """
    try:
        with open_picture(path):
            grey = _decoded(path, cv2.IMREAD_GRAYSCALE)
    except CaptureError as error:
        raise CaptureError(error.code, f"{error}; run again with --from ingest") from None
    if grey is None:
        text = f"{path}: cannot be read as a picture; run again with --from ingest"
        raise CaptureError("picture-unreadable", text)
    return grey


def copy_upright(info: PictureInfo, folder: Path, stem: str) -> str:
    """Put one photo upright into `folder` as `stem` plus suffix; the name of the file written.

    Upright JPEG and 8-bit PNG files are copied bit by bit. Turned JPEG files are written again.
    """
    suffix = info.path.suffix.lower()
    if not info.turned and (suffix in JPEG_SUFFIXES or (suffix == ".png" and _is_8_bit(info.path))):
        name = stem + (".jpg" if suffix in JPEG_SUFFIXES else ".png")
        shutil.copyfile(info.path, folder / name)
        return name
    name = stem + (".jpg" if suffix in JPEG_SUFFIXES else ".png")
    write_picture(folder / name, read_picture(info.path), quality=JPEG_QUALITY)
    return name


def write_picture(
    path: Path, rgb: UInt8[np.ndarray, "height width channels"], quality: int = JPEG_QUALITY
) -> None:
    """Write RGB or RGBA as PNG or JPEG, by the suffix of `path`; a full disk is an OSError."""
    write_bgr(path, rgb[:, :, [2, 1, 0, 3][: rgb.shape[2]]], quality)


def write_bgr(path: Path, bgr: UInt8[np.ndarray, "height width channels"], quality: int) -> None:
    """As `write_picture`, in OpenCV's order of colours."""
    suffix = path.suffix.lower()
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in JPEG_SUFFIXES else PNG_OPTIONS
    done, data = cv2.imencode(suffix, bgr, options)
    if not done:
        raise ValueError(f"{path}: OpenCV cannot write {suffix}")
    path.write_bytes(data.data)


def _decoded(path: Path, flag: int) -> np.ndarray | None:
    """Pixels as OpenCV reads them; None where it cannot. Its header is known to be in order."""
    try:
        return cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), flag)
    except cv2.error:
        return None


def _orientation(image: Image.Image) -> int:
    value = tags_of(image).get(ExifTags.Base.Orientation, 1)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _is_8_bit(path: Path) -> bool:
    with open_picture(path) as image:
        return image.mode in ("L", "P", "RGB", "RGBA")
