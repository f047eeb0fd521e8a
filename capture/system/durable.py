"""Files that outlive a power cut: what was written lies on the disk before it is given a name that counts."""

import ctypes
import errno
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from devrf.capture.system.limits import is_device

MANY_FILES = 32  # from here on the whole file system is put on the disk at once, which is quicker
# said by network file systems that keep names by themselves
NOT_FOR_FOLDERS = (errno.EINVAL, errno.EOPNOTSUPP)


@contextmanager
def whole(path: Path, *, alone: bool = False) -> Iterator[Path]:
    """A file to write into, which gets the name of `path` once it lies on the disk; what fails leaves nothing.

    Args:
        path: The name.
        alone: No two processes ever write it at once: what a kill leaves half written is written over the next time.
    """
    of_process = "" if alone else f".{os.getpid()}"
    new = path.with_name(f".{path.name.lstrip('.')}{of_process}.tmp")
    try:
        yield new
        sync(new)
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any, *, indent: int | None = 1) -> None:
    """Write a file of ours, whole or not at all; numbers are finite. `indent`: None writes all in one line."""
    with whole(path) as new:
        new.write_text(json.dumps(value, indent=indent, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """What a file of ours holds.

    Raises:
        ValueError: It is damaged: no JSON, nested deeper than anything that we write, or no file.
        OSError: It cannot be read.
    """
    if is_device(path):
        raise ValueError("a device or a pipe")
    return parse_json(path.read_bytes())


def read_object(path: Path) -> dict[str, Any]:
    """The object that a file of ours holds; empty where there is no file. Raises as `read_json` does."""
    return read_json(path) if path.is_file() else {}


def parse_json(text: str | bytes) -> Any:
    """What stands in a file of ours; damage of every kind is a ValueError."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def sync_tree(folder: Path) -> None:
    """Return when all files and folders below a folder, and itself, lie on the disk.

    Raises:
        OSError: They do not: the disk is full after all, or fails.
    """
    paths = list(_tree(folder))
    if len(paths) >= MANY_FILES and sync_file_system(folder):
        return
    for path in paths:
        sync(path)


def sync(path: Path) -> None:
    """Return when one file, or the names in one folder, lie on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in NOT_FOR_FOLDERS or not path.is_dir():
            raise
    finally:
        os.close(handle)


def sync_file_system(folder: Path) -> bool:
    """Put all that was written where a folder lies on the disk; False where the system cannot do this."""
    if sys.platform != "linux":
        return False
    handle = os.open(folder, os.O_RDONLY)
    try:
        if ctypes.CDLL(None, use_errno=True).syncfs(handle) != 0:
            raise OSError(ctypes.get_errno(), f"{os.strerror(ctypes.get_errno())}: {folder}")
    finally:
        os.close(handle)
    return True


def _tree(folder: Path) -> Iterator[Path]:
    """Files, then the folders that hold them; links are names, which their folder holds."""
    for root, _, files in os.walk(folder, topdown=False):
        yield from (path for name in files if not (path := Path(root, name)).is_symlink())
        yield Path(root)
