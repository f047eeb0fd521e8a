"""Picture files as they are stored: bytes in, RGB or RGBA out, and back to PNG.

Only Pillow is needed, so that training runs where no video or vision library is installed. EXIF orientation is
not applied: the cameras of a scene belong to the pixels as they are stored (`upright_pictures.py` turns photos).
"""

import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from PIL import Image, ImageFile, UnidentifiedImageError

from devrf.capture.colour.photo_profile import as_srgb, photo_space
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import CaptureError, DevrfError
from devrf.capture.system.limits import check_pixels

JPEG_SUFFIXES = frozenset((".jpg", ".jpeg", ".jpe", ".jfif", ".jif"))
PICTURE_SUFFIXES = JPEG_SUFFIXES | frozenset((".png", ".tif", ".tiff", ".bmp", ".webp"))
FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP")  # plain pixels; others of Pillow's run programs (EPS)
WITH_ALPHA = frozenset(("LA", "La", "PA", "RGBA", "RGBa"))
KEYED = frozenset(("P", "RGB"))  # modes in which one colour may be declared transparent
DEEP_GREY = frozenset(("I", "I;16", "I;16B", "I;16L", "I;16N"))  # 16 bits; "I" in older releases of Pillow
UNREAD_STARTS = (  # place and bytes by which pictures that are not read are known
    (4, b"ftyphei", "a HEIC photo"),
    (4, b"ftyphev", "a HEIC photo"),
    (4, b"ftypmif1", "a HEIC photo"),
    (4, b"ftypavif", "an AVIF photo"),
    (0, b"\xff\x0a", "a JPEG XL photo"),
    (4, b"JXL ", "a JPEG XL photo"),
    (4, b"jP  ", "a JPEG 2000 photo"),
)
# Times the size at which a picture is used that it is decoded at, at least: shrunk, it is then 43 to 56 dB from one
# that was decoded whole, a level or two in the mean.
SPARE = 2
PNG_LEVEL = 1  # against the default 6: 128 and 466 ms, 717 and 639 kB for a photo of 540 x 960


def natural_key(name: str) -> tuple:
    """Sort key under which frame2 comes before frame10."""
    return tuple((0, int(p), "") if p.isdigit() else (1, 0, p) for p in re.split(r"(\d+)", name.lower()) if p)


@contextmanager
def open_picture(path: Path) -> Iterator[ImageFile.ImageFile]:
    """A picture of which the header is read, and known to be of a size that can be.

    Raises:
        CaptureError: The file is missing, damaged, too large or not a picture, also where that shows inside the `with`.
    """
    Image.MAX_IMAGE_PIXELS = None  # Pillow's limit is below what cameras make; ours is asked here
    try:
        with Image.open(path, formats=FORMATS) as image:
            check_pixels(path, *image.size)
            yield image
    except (DevrfError, MemoryError):
        raise
    except FileNotFoundError:
        text = f"{path}: no such file; make it again or remove it from the set"
        raise CaptureError("picture-missing", text) from None
    except UnidentifiedImageError:
        kind = _kind_unread(path)
        if kind is not None:
            text = f"{path}: holds {kind}, whatever its name says, which is not read; convert it to JPEG"
            raise CaptureError("picture-kind-unread", text) from None
        text = f"{path}: cannot be read: not a picture; save it as JPEG or PNG, or remove it"
        raise CaptureError("picture-unreadable", text) from None
    except Exception as error:  # what Pillow raises of damaged files depends on their bytes
        text = f"{path}: cannot be read as a picture ({error}); make it again or remove it from the set"
        raise CaptureError("picture-unreadable", text) from error


def read_pixels(path: Path) -> UInt8[np.ndarray, "height width channels"]:
    """sRGB, with transparency where the file has it; grey becomes RGB, 16 bits are rounded to 8.

    Raises:
        CaptureError: The file is missing, damaged or not a picture.
    """
    with open_picture(path) as image:
        return as_srgb(_stored(path, image), photo_space(image))


def read_reduced(
    path: Path, width: int, height: int
) -> tuple[UInt8[np.ndarray, "height width channels"], int]:
    """The same for use at a smaller size: a JPEG that is much larger is decoded at a half, a quarter or an eighth.

    Its blocks' low frequencies are enough for that; a quarter of a picture of 3840 x 2160 takes 12 instead of 76 ms.

    Args:
        path: The file.
        width, height: Size at which it will be used; what is returned is `SPARE` times as large or more.
    Returns:
        The picture, and by what its sides are divided.
    """
    with open_picture(path) as image:
        least = SPARE * width, SPARE * height
        fine = (n for n in (8, 4, 2) if image.format == "JPEG" and _divides(n, image.size, least))
        divisor = next(fine, 1)
        if divisor > 1:
            image.draft(None, (image.width // divisor, image.height // divisor))
        return as_srgb(_stored(path, image), photo_space(image)), divisor


def damaged_pictures(paths: Iterable[Path]) -> list[str]:
    """What is wrong with picture files that cannot be read to the end, one text per file."""

    def problem(path: Path) -> str | None:
        try:
            read_pixels(path)
        except CaptureError as error:
            return str(error)
        return None

    with ThreadPoolExecutor(usable_cores()) as pool:  # decoding lets other threads run
        return [text for text in pool.map(problem, dict.fromkeys(paths)) if text is not None]


def to_8_bits(picture: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """A picture in [0, 1] as bytes."""
    return np.clip(np.round(picture * 255), 0, 255).astype(np.uint8)


def write_png(
    path: Path, picture: UInt8[np.ndarray, "height width *channels"] | UInt16[np.ndarray, "height width"]
) -> None:
    """Write grey (8 or 16 bits), RGB or RGBA; a full disk is an OSError."""
    Image.fromarray(picture).save(path, format="PNG", compress_level=PNG_LEVEL)


def _divides(n: int, size: tuple[int, int], least: tuple[int, int]) -> bool:
    """Whether both sides are multiples of `n`, so that no pixel is cut, and large enough afterwards."""
    return all(side % n == 0 and side // n >= few for side, few in zip(size, least, strict=True))


def _kind_unread(path: Path) -> str | None:
    """The kind of a picture that is one, but is not read, by its first bytes."""
    with path.open("rb") as file:
        head = file.read(16)
    return next((kind for at, start, kind in UNREAD_STARTS if head[at : at + len(start)] == start), None)


def _stored(path: Path, image: ImageFile.ImageFile) -> UInt8[np.ndarray, "height width channels"]:
    """Levels as they are stored, as RGB or RGBA."""
    if image.mode in DEEP_GREY:
        grey = _rounded(np.asarray(image))
        return grey[:, :, None].repeat(3, axis=2)
    if image.mode == "F":
        wrong = f"{path}: its pixels are real numbers, expected 8 or 16 bits"
        raise CaptureError("picture-kind-unread", f"{wrong}; make it again or remove it from the set")
    deep = _deep_colour(path, image)
    if deep is not None:
        return deep
    keyed = image.mode in KEYED and "transparency" in image.info
    mode = "RGBA" if keyed or image.mode in WITH_ALPHA else "RGB"
    return np.array(image if image.mode == mode else image.convert(mode))


def _deep_colour(path: Path, image: ImageFile.ImageFile) -> np.ndarray | None:
    """A PNG with 16 bits per colour, rounded; None for all others.

    Pillow keeps the first byte of each value. Read once more as if the bytes were the other way round, it
    keeps the second.
    """
    raw = image.tile[0][3] if image.format == "PNG" and image.tile else None
    if raw not in ("RGB;16B", "RGBA;16B"):
        return None
    high = np.asarray(image).astype(np.uint16)
    with open_picture(path) as again:
        swapped = (*again.tile[0][:3], str(raw).replace("16B", "16L"))
        again.tile = [swapped]  # pyright: ignore[reportAttributeAccessIssue]: a plain tuple in older releases
        return _rounded((high << 8) | np.asarray(again))


def _rounded(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0, 65535) / 257.0).astype(np.uint8)
