"""Arrays of numpy on disk (npy, npz), as data only: no pickle, and sizes are checked before memory is taken."""

import math
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from io import BufferedIOBase
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from devrf.capture.system.errors import CaptureError
from devrf.capture.system.limits import ARRAY_BYTES, check_bytes

HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
NUMBERS, TEXT = "biuf", "U"  # numpy's kinds


class ArrayError(CaptureError):
    """A file of arrays that is missing, damaged, too large, or holds something else."""


def read_npz(path: Path, names: Iterable[str] | None = None, *, text: bool = False) -> dict[str, np.ndarray]:
    """Arrays of an npz by name.

    Args:
        path: The file.
        names: Which of them; None: all.
        text: Whether they may hold text as well as numbers.
    Raises:
        ArrayError: One is missing or damaged, holds something else, or together they are larger than `ARRAY_BYTES`.
    """
    with _opened(path) as (archive, entries):
        wanted = [_entry(entries, name) for name in (entries if names is None else names)]
        check_bytes(path, ARRAY_BYTES, sum(entry.file_size for entry in wanted))
        return {_name(e): _array(partial(archive.open, e), e.file_size, text) for e in wanted}


def npz_shapes(path: Path, names: Iterable[str]) -> list[tuple[int, ...]]:
    """Shapes of arrays of an npz by their headers alone; errors as `read_npz`."""
    found = []
    with _opened(path) as (archive, entries):
        for name in names:
            with archive.open(_entry(entries, name)) as file:
                found.append(_header(file)[0])
    return found


def read_npy(path: Path) -> np.ndarray:
    """The numbers of an npy; errors as `read_npz`."""
    with _errors_named(path):
        check_bytes(path, ARRAY_BYTES)
        return _array(partial(path.open, "rb"), path.stat().st_size, text=False)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """The archive of an npz, and its entries by the name of the array."""
    with _errors_named(path), zipfile.ZipFile(path) as archive:
        yield archive, {_name(entry): entry for entry in archive.infolist()}


@contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    """What zip, zlib and numpy's header parser raise of damaged files depends on their bytes: all of it is damage."""
    try:
        yield
    except MemoryError:
        raise
    except CaptureError as error:
        raise ArrayError(error.code, str(error)) from None
    except FileNotFoundError:
        raise ArrayError("file-missing", f"{path}: no such file") from None
    except Exception as error:
        text = f"{path}: damaged or not a file of arrays ({error or type(error).__name__})"
        raise ArrayError("file-damaged", text) from None


def _name(entry: zipfile.ZipInfo) -> str:
    return entry.filename.removesuffix(".npy")


def _entry(entries: dict[str, zipfile.ZipInfo], name: str) -> zipfile.ZipInfo:
    if name not in entries:
        raise ValueError(f"no array {name} in it")
    return entries[name]


def _array(opened: Callable[[], IO[bytes]], size: int, text: bool) -> np.ndarray:
    """An array of `size` bytes with its header, which is looked at first: numpy takes the memory that it asks for.

    Opened again, not wound back: an entry of a zip would no longer be compared with its checksum.
    """
    with opened() as file:
        shape, dtype = _header(file)
        there = size - file.tell()
    if dtype.kind not in (NUMBERS + TEXT if text else NUMBERS):
        raise ValueError(f"holds values of type {dtype}, expected numbers{' or text' if text else ''}")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != there:
        raise ValueError(f"its header says {dtype} of shape {list(shape)}, it has {there} bytes of them")
    with opened() as file:
        return npy.read_array(file, allow_pickle=False)


def _header(file: IO[bytes] | BufferedIOBase) -> tuple[tuple[int, ...], np.dtype]:
    version = npy.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format")
    shape, _, dtype = HEADERS[version](file)
    return shape, dtype
