"""How the picture in a RAW file that is a TIFF (DNG, NEF, ARW, ...) is compressed, by its tags; no pixel is read."""

import struct
from pathlib import Path
from typing import BinaryIO

SUBFILE, COMPRESSION, SUB_IFDS = 254, 259, 330  # tags of TIFF 6.0 and its extension by directories
FULL_PICTURE = 0  # of tag 254; others are previews
NAMES = {34713: "Nikon's high efficiency", 34892: "lossy JPEG", 52546: "JPEG XL"}
MOST_DIRECTORIES, MOST_TAGS = 64, 4096
ORDERS = {b"II": "<", b"MM": ">"}
FORMATS = {1: "B", 3: "H", 4: "I", 13: "I"}  # of the types that these tags have


def compression_of(path: Path) -> int | None:
    """Tag 259 of the full picture; None where the file is no TIFF or does not say."""
    with path.open("rb") as file:
        head = file.read(8)
        order = ORDERS.get(head[:2])
        if order is None:
            return None
        todo = [_number(head[4:], f"{order}I")]
        for _ in range(MOST_DIRECTORIES):
            if not todo:
                break
            tags, following = _directory(file, todo.pop(), order)
            if tags.get(SUBFILE) == (FULL_PICTURE,) and COMPRESSION in tags:
                return tags[COMPRESSION][0]
            todo += [*([following] if following else []), *tags.get(SUB_IFDS, ())]
    return None


def compression_words(path: Path) -> str:
    """What to call it: "JPEG XL (compression 52546)"; empty where it is not known."""
    number = compression_of(path)
    return "" if number is None else f"{NAMES.get(number, 'a kind of its maker')} (compression {number})"


def _number(data: bytes, form: str) -> int:
    return struct.unpack(form, data)[0] if len(data) == struct.calcsize(form) else 0


def _directory(file: BinaryIO, at: int, order: str) -> tuple[dict[int, tuple[int, ...]], int]:
    """The tags of a directory that are asked for, and where the next directory is; 0 for none."""
    file.seek(at)
    entries = [file.read(12) for _ in range(min(_number(file.read(2), f"{order}H"), MOST_TAGS))]
    following = _number(file.read(4), f"{order}I")
    tags: dict[int, tuple[int, ...]] = {}
    for entry in entries:
        if len(entry) < 12:
            continue
        tag, kind, count = struct.unpack(f"{order}HHI", entry[:8])
        if (
            tag not in (SUBFILE, COMPRESSION, SUB_IFDS)
            or kind not in FORMATS
            or not 0 < count <= MOST_DIRECTORIES
        ):
            continue
        form = struct.Struct(f"{order}{count}{FORMATS[kind]}")
        data = entry[8:]
        if form.size > len(data):
            file.seek(_number(data, f"{order}I"))
            data = file.read(form.size)
        if len(data) >= form.size:
            tags[tag] = form.unpack(data[: form.size])
    return tags, following
