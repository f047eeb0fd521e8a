"""Arrays of numpy on disk (npy, npz), as data only: no pickle, and sizes are checked before memory is taken."""

import math
import zipfile
from collections.abc import Iterable
from io import BufferedIOBase
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from devrf.capture.errors import CaptureError
from devrf.capture.limits import ARRAY_BYTES, check_bytes

HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


class ArrayError(CaptureError):
    """A file of arrays that is missing, damaged, too large, or holds something else."""


def read_npz(
    path: Path, names: Iterable[str] | None = None, most: int = ARRAY_BYTES
) -> dict[str, np.ndarray]:
    """Arrays of an npz by name; `names` None: all.

    Raises:
        ArrayError: One is missing or damaged, or they are larger than `most` bytes.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            wanted = list(entries) if names is None else list(names)
            check_bytes(path, most, sum(_entry(entries, name).file_size for name in wanted))
            return {name: _read(archive, entries[name]) for name in wanted}
    except Exception as error:
        raise _named(path, error) from None


def npz_shapes(path: Path, names: Iterable[str]) -> list[tuple[int, ...]]:
    """Shapes of arrays of an npz by their headers alone; errors as `read_npz`."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {i.filename.removesuffix(".npy"): i for i in archive.infolist()}
            found = []
            for name in names:
                with archive.open(_entry(entries, name)) as file:
                    found.append(_header(file)[0])
            return found
    except Exception as error:
        raise _named(path, error) from None


def read_npy(path: Path) -> np.ndarray:
    """The array of an npy; errors as `read_npz`."""
    try:
        check_bytes(path, ARRAY_BYTES)
        with path.open("rb") as file:
            _check(*_header(file), path.stat().st_size - file.tell())
            file.seek(0)
            return npy.read_array(file, allow_pickle=False)
    except Exception as error:
        raise _named(path, error) from None


def _read(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as file:
        _check(*_header(file), entry.file_size - file.tell())
    with archive.open(entry) as file:
        return npy.read_array(file, allow_pickle=False)


def _entry(entries: dict[str, zipfile.ZipInfo], name: str) -> zipfile.ZipInfo:
    if name not in entries:
        raise ValueError(f"no array {name} in it")
    return entries[name]


def _header(file: IO[bytes] | BufferedIOBase) -> tuple[tuple[int, ...], np.dtype]:
    version = npy.read_magic(file)
    if version not in HEADERS:
        raise ValueError(f"version {version} of the format")
    shape, _, dtype = HEADERS[version](file)
    return shape, dtype


def _check(shape: tuple[int, ...], dtype: np.dtype, there: int) -> None:
    """numpy takes the memory that a header asks for before it reads."""
    if dtype.hasobject:
        raise ValueError("holds Python objects, expected numbers or text")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != there:
        raise ValueError(f"its header says {dtype} of shape {list(shape)}, it has {there} bytes of them")


def _named(path: Path, error: Exception) -> ArrayError:
    """What zip, zlib and numpy's header parser raise of damaged files depends on their bytes: all of it is damage."""
    if isinstance(error, MemoryError):
        raise error
    if isinstance(error, CaptureError):
        return ArrayError(str(error))
    if isinstance(error, FileNotFoundError):
        return ArrayError(f"{path}: no such file")
    return ArrayError(f"{path}: damaged or not a file of arrays ({error or type(error).__name__})")
