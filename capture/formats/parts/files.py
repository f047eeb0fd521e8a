"""Files of data sets: text and JSON, and what the header of a picture says before its pixels are read."""

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path, PureWindowsPath
from typing import Any

from devrf.capture.photos.picture_files import open_picture
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.file_names import safe
from devrf.capture.system.limits import TEXT_BYTES, check_bytes

LONGEST_NAME = 64  # of a camera, characters
PICTURE_ENDINGS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
GREY_MODES = ("1", "L", "I;16", "I;16B", "I")  # Pillow's names
COLOUR_MODES = ("RGB", "RGBA", "P", "RGBX")
# Of an entry.
REQUIRED = (("file_path", str, "the path of a picture"), ("transform_matrix", list, "4 rows of 4 numbers"))


@dataclass(frozen=True)
class Header:
    """What a picture's header says: its file, size in pixels, and whether it is grey or has alpha."""

    path: Path
    width: int
    height: int
    grey: bool
    alpha: bool

    @property
    def size(self) -> str:
        """`640x480`, for messages."""
        return f"{self.width}x{self.height}"


def find_picture(base: Path, name: str) -> Path:
    """The file that a data set names.

    Where there is none of that very name: with a usual ending added (Blender's layout names pictures without one), with
    its ending in capitals or small letters, or with each backslash as a slash (paths of Windows). A whole path of
    another machine is that of the file which lies in `base` under the longest end of it.

    Args:
        base: Folder that the name is relative to.
        name: As the data set has it.
    Raises:
        CaptureError: There is no such file.
    """
    for written in dict.fromkeys((name, with_slashes(name), *_ends(name))):
        file = base / written
        names = [file.name + ending for ending in PICTURE_ENDINGS]
        names += [file.stem + change(file.suffix) for change in (str.lower, str.upper)]
        for candidate in (file.with_name(other) for other in names if file.name):
            if os.path.isfile(candidate):  # not so what has too long a name
                return candidate.resolve()
    remedy = "copy it into the data set, or remove its entry"
    if _ends(name):
        text = f"{name}: picture not found, nor one of that name in {base}; {remedy}"
        raise CaptureError("picture-missing", text)
    wrong = f"{base / name}: picture not found (nor with .png or .jpg added)"
    raise CaptureError("picture-missing", f"{wrong}; {remedy}")


def _ends(name: str) -> list[str]:
    """What a whole path may be relative to the data set, the longest first; nothing of a relative one."""
    written = with_slashes(name)
    if not written.startswith("/") and not PureWindowsPath(name).drive:
        return []
    parts = [part for part in written.split("/") if part and not part.endswith(":")]
    return ["/".join(parts[n:]) for n in range(len(parts)) if ".." not in parts[n:]]


def with_slashes(name: str) -> str:
    """A path as it would be written elsewhere than on Windows."""
    return name.replace("\\", "/")


def read_header(path: Path) -> Header:
    """Size and channels of a picture.

    Raises:
        CaptureError: Not a picture, or one with neither one, three nor four channels.
    """
    with open_picture(path) as image:
        mode, (width, height) = image.mode, image.size
        alpha = mode == "RGBA" or "transparency" in image.info
    if mode in GREY_MODES:
        return Header(path, width, height, True, False)
    if mode in COLOUR_MODES:
        return Header(path, width, height, False, alpha)
    count = {"LA": "2 channels (grey and transparency)", "PA": "2 channels (palette and transparency)"}
    text = f"{path}: {count.get(mode, f'pixels of kind {mode}')}; expected grey, RGB or RGBA; save it as RGB or RGBA"
    raise CaptureError("picture-kind-unread", text)


def read_text(path: Path, most: int = TEXT_BYTES) -> str:
    """UTF-8 text of at most `most` bytes, with or without the signature that Windows programs put before it.

    Raises:
        CaptureError: Larger, or not UTF-8.
        OSError: It cannot be read.
    """
    check_bytes(path, most)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        wrong = f"{path}: not UTF-8 text ({error.reason} at byte {error.start})"
        remedy = "save it as UTF-8 (UTF-16 is not read), or copy it again if it is damaged"
        raise CaptureError("encoding-wrong", f"{wrong}; {remedy}") from None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object.

    Raises:
        CaptureError: The file is missing, is not JSON in UTF-8, or holds something else.
    """
    try:
        value = json.loads(read_text(path), parse_int=_whole)
    except FileNotFoundError:
        text = f"{path}: file not found; check dataset.path and dataset.format"
        raise CaptureError("file-missing", text) from None
    except (OSError, ValueError, RecursionError) as error:
        raise CaptureError("file-damaged", f"{path}: not a JSON file ({error}); copy it again") from None
    if not isinstance(value, dict):
        text = f"{path}: holds a {type(value).__name__}; expected an object with the key frames"
        raise CaptureError("file-damaged", text)
    return value


def write_json(path: Path, value: dict[str, Any]) -> None:
    """Write a JSON object; folders on the way are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1) + "\n")


def frames_of(meta: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """The entries of a transforms file, each known to be an object with `file_path` and `transform_matrix`."""
    entries = meta.get("frames")
    if not isinstance(entries, list) or not entries:
        text = f"{path}: no frames listed; expected a list frames with an entry per picture"
        raise CaptureError("pictures-none", text)
    for n, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise CaptureError("entry-wrong", f"{path}: frames[{n}] is {entry!r}; expected an object")
        for key, kind, what in REQUIRED:
            if not isinstance(entry.get(key), kind):
                text = f"{path}: frames[{n}].{key} is {entry.get(key)!r}; expected {what}"
                raise CaptureError("entry-wrong", text)
    return entries


def number(value: Any, key: str, where: str) -> float:
    """A value that must be a finite number; `key` and `where` name it in the error."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CaptureError("entry-wrong", f"{where}: {key} is {value!r}; expected a number")
    return float(value)


def number_or_none(entry: dict[str, Any], key: str, where: str) -> float | None:
    """The number of a key that may be missing."""
    return None if entry.get(key) is None else number(entry[key], key, where)


def relative_to(path: Path, base: Path) -> str:
    """`path` relative to `base`, so that a folder can be moved together with its pictures."""
    return Path(os.path.relpath(path.resolve(), base)).as_posix()


def safe_name(name: object) -> str:
    """A name that can be a file's: letters of any alphabet, digits, `_` and `-`."""
    return safe(str(name))[:LONGEST_NAME].strip("_") or "camera"


def _whole(digits: str) -> int | float:
    """Of hundreds of digits no array can be made, nor are they asked whether they are finite."""
    return int(digits) if len(digits) < 20 else float(digits)
