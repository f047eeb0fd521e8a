"""The rate at which a mov or mp4 file's timecode track counts; FFmpeg does not hand it on.

A track of kind `tmcd` is described (QuickTime File Format, Timecode Sample Description) by a timescale, the duration of
a frame in it, and the number of frames it counts in a second: 30 000, 1001 and 30 for 29.97, whatever the pictures are.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

LISTS = frozenset((b"moov", b"trak", b"mdia", b"minf", b"stbl"))  # boxes that hold boxes on the way there
STSD_HEAD = 8  # version, flags and the number of entries, before the entries
ENTRY = struct.Struct(">6xH4xIIIB")  # data reference, flags, timescale, frame duration, frames
MOST_BOXES = 10_000


def timecode_rate(path: Path) -> float | None:
    """Frames a second of the first timecode track; None where the file has none, or is of another kind."""
    with path.open("rb") as file:
        for kind, size in _entries(file, path.stat().st_size):
            if kind == b"tmcd" and size >= ENTRY.size:
                _, _, timescale, duration, _ = ENTRY.unpack(file.read(ENTRY.size))
                return timescale / duration if timescale and duration else None
    return None


def _entries(file: BinaryIO, end: int) -> Iterator[tuple[bytes, int]]:
    """Sample descriptions of all tracks: kind and size of the content, at which the file then stands."""
    todo = [(0, end)]
    for _ in range(MOST_BOXES):
        if not todo:
            return
        at, end = todo.pop()
        file.seek(at)
        head = file.read(16)
        if at + 8 > end or len(head) < 8:
            continue
        size, kind, start = int.from_bytes(head[:4], "big"), head[4:8], at + 8
        if size == 1:
            size, start = int.from_bytes(head[8:16], "big"), at + 16
        size = end - at if size == 0 else size
        if size < start - at or at + size > end:
            continue
        todo.append((at + size, end))
        if kind in LISTS:
            todo.append((start, at + size))
        elif kind == b"stsd":
            file.seek(start + STSD_HEAD)
            entry = file.read(8)
            if len(entry) == 8:
                yield entry[4:], size - (start - at) - STSD_HEAD - 8
