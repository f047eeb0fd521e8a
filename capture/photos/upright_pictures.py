"""Photos, upright and in sRGB.

A photo's EXIF orientation is applied once, here; files that need no turn are taken as they are. A lens belongs to the
stored picture, and cameras that look down guess their turn: so all photos of a camera are turned alike
(`shared_turns`).
"""

import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image

from devrf.capture.colour.photo_profile import PhotoSpace, as_srgb, photo_space
from devrf.capture.exif import Exif, read_exif, tags_of
from devrf.capture.orientation import Upright, by_exif
from devrf.capture.photos.picture_files import JPEG_SUFFIXES, open_picture
from devrf.capture.photos.raw import develop, is_raw, read_layout
from devrf.capture.projection import Projection, of_xmp
from devrf.capture.system.errors import CaptureError

JPEG_QUALITY = 97  # of photos that had to be turned: a second JPEG at this quality costs < 1 level RMS
# Twice as fast as level 1 alone, and smaller (46 against 93 ms, 1.17 against 1.30 MB for 1080x1920).
PNG_OPTIONS = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
TURNED_BY_READERS = ("TIFF",)  # Pillow and OpenCV turn these themselves, whatever they are asked
TO_RGB = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}  # by channels as OpenCV reads


@dataclass(frozen=True)
class PictureInfo:
    """What a photo's header says.

    Attributes:
        path: The file.
        width, height: Size of the picture that its tag makes upright, pixels.
        upright: The turn and mirror that its tag asks for.
        exif: What its tags say of device, lens and place; None for RAW files.
        space: What its levels mean, where that is not sRGB.
        projection: What its tags say of pictures that are no lens's; None: nothing.
    """

    path: Path
    width: int
    height: int
    upright: Upright
    exif: Exif | None
    space: PhotoSpace | None = None
    projection: Projection | None = None


def probe_picture(path: Path) -> PictureInfo:
    """Read a photo's header.

    Raises:
        InputError: If the file is not a RAW file.
        CaptureError: If the file is not a picture, or larger than can be read.
    """
    if is_raw(path):
        raw = read_layout(path)
        size = raw.upright.size(raw.width, raw.height)
        return PictureInfo(path, *size, raw.upright, None)
    with open_picture(path) as image:
        upright = _own(image)
        size = image.size if image.format in TURNED_BY_READERS else upright.size(*image.size)
        said = of_xmp(image.info.get("xmp"))
        return PictureInfo(path, *size, upright, read_exif(image), photo_space(image), said)


def shared_turns(infos: Sequence[PictureInfo]) -> list[Upright]:
    """How each of a folder's photos is turned: as most of the same device and stored size ask for."""
    keys = [
        ("" if i.exif is None else i.exif.device, i.upright.size(i.width, i.height), is_raw(i.path))
        for i in infos
    ]
    asked: dict[object, Counter[Upright]] = {}
    for key, info in zip(keys, infos, strict=True):
        asked.setdefault(key, Counter())[info.upright] += 1
    return [asked[key].most_common(1)[0][0] for key in keys]


def read_picture(path: Path, upright: Upright | None = None) -> UInt8[np.ndarray, "height width channels"]:
    """Read a photo upright: sRGB, with transparency where the file has it; 16 bits are rounded to 8.

    A RAW file is developed as a set of its own (`capture.raw_set` develops a folder by one recipe).

    Args:
        path: The photo.
        upright: How it is turned; None: as its tag asks for.
    Raises:
        InputError: If the file is not a RAW file.
        CaptureError: If it is not a picture, too large, or damaged.
    """
    if is_raw(path):
        rgb, own = develop(path).rgb, read_layout(path).upright
        return rgb if upright is None else own.inverse.then(upright).apply(rgb)
    with open_picture(path) as header:
        own, space = _own(header), photo_space(header)
        turned = header.format in TURNED_BY_READERS
    image = _decoded(path, cv2.IMREAD_UNCHANGED)
    if image is None:
        text = f"{path}: the picture does not decode; copy it from the camera again"
        raise CaptureError("picture-unreadable", text)
    if image.dtype == np.uint16:
        image = np.round(image / 257.0).astype(np.uint8)
    if image.dtype != np.uint8:
        raise CaptureError("picture-kind-unread", f"{path}: pixels are {image.dtype}, expected 8 or 16 bits")
    in_order = cv2.cvtColor(image, TO_RGB[image.shape[2] if image.ndim == 3 else 1])
    wanted = own if upright is None else upright
    turn = own.inverse.then(wanted) if turned else wanted
    return np.ascontiguousarray(turn.apply(as_srgb(in_order, space))).astype(np.uint8, copy=False)


def read_grey(path: Path) -> UInt8[np.ndarray, "height width"]:
    """A frame of a run as grey levels; of a JPEG those that are stored, without its colours.

    Raises:
        CaptureError: It cannot be read.
    """
    try:
        with open_picture(path):
            grey = _decoded(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except CaptureError as error:
        raise CaptureError(error.code, f"{error}; run again with --from ingest") from None
    if grey is None:
        text = f"{path}: cannot be read as a picture; run again with --from ingest"
        raise CaptureError("picture-unreadable", text)
    return grey


def copy_upright(info: PictureInfo, upright: Upright, folder: Path, stem: str) -> str:
    """Put one photo, turned so, into `folder` as `stem` plus suffix; the name of the file written.

    JPEG and 8-bit PNG files that are upright, in sRGB and say so are copied bit by bit. Others are written again,
    without tags.
    """
    suffix = info.path.suffix.lower()
    if (
        upright.nothing
        and info.upright.nothing
        and (info.space is None or info.space.light is None)
        and (suffix in JPEG_SUFFIXES or (suffix == ".png" and _is_8_bit(info.path)))
    ):
        name = stem + (".jpg" if suffix in JPEG_SUFFIXES else ".png")
        shutil.copyfile(info.path, folder / name)
        return name
    name = stem + (".jpg" if suffix in JPEG_SUFFIXES else ".png")
    write_picture(folder / name, read_picture(info.path, upright), quality=JPEG_QUALITY)
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


def _own(image: Image.Image) -> Upright:
    """What the tag of a picture asks for that was opened, and not decoded."""
    value = tags_of(image).get(ExifTags.Base.Orientation, 1)
    return by_exif(value if isinstance(value, int) else 1)


def _is_8_bit(path: Path) -> bool:
    with open_picture(path) as image:
        return image.mode in ("L", "P", "RGB", "RGBA")
