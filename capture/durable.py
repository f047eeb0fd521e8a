"""Files that outlive a power cut: what was written lies on the disk before it is given a name that counts."""

import ctypes
import errno
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from devrf.capture.limits import is_device

MANY_FILES = 32  # from here on the whole file system is put on the disk at once, which is quicker
# said by network file systems that keep names by themselves
NOT_FOR_FOLDERS = (errno.EINVAL, errno.EOPNOTSUPP)


def write_json(path: Path, value: Any) -> None:
    """Write a file whole or not at all, and make it durable."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(json.dumps(value, indent=1, allow_nan=False), encoding="utf-8")
        sync(temporary)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def read_json(path: Path) -> Any:
    """What a file of ours holds.

    Raises:
        ValueError: It is damaged: no JSON, nested deeper than anything that we write, or no file.
        OSError: It cannot be read.
    """
    if is_device(path):
        raise ValueError("a device or a pipe")
    return parse_json(path.read_bytes())


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
