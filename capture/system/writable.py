"""Whether something can be written, asked before the work is done that would be lost."""

import errno
import os
import tempfile
from collections.abc import Collection
from pathlib import Path

from devrf.capture.system.errors import InputError
from devrf.capture.system.limits import TEXT_BYTES


def check_folder(folder: Path, what: str) -> None:
    """Refuse a folder that cannot be made or written into; nothing is made yet.

    Args:
        folder: It may be missing, with the folders above it.
        what: Names it in the message: `--out`, `output`.
    Raises:
        InputError: A file stands in its way, or this user may not write there.
    """
    there, unknown = _nearest(folder)
    if unknown is not None:
        reason = f"{there}: {unknown}"
    elif not os.path.isdir(there):
        reason = f"{there} is a file"
    elif not os.access(there, os.W_OK | os.X_OK):
        reason = f"{there} may not be written"
    elif not _takes_files(there):
        reason = f"{there} takes no files"
    else:
        return
    wrong = f"{what} {folder}: cannot be written ({reason})"
    raise InputError("folder-unwritable", f"{wrong}; choose another folder, or make it writable")


def _nearest(folder: Path) -> tuple[Path, str | None]:
    """A folder, or the nearest one above it that is there; and why that cannot be known, where it cannot."""
    for place in (folder, *folder.absolute().parents):
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError):
            continue
        except (OSError, ValueError) as error:  # too long a name, no right to look, a zero byte
            return place, getattr(error, "strerror", None) or str(error)
        return place, None
    return Path(folder.absolute().anchor), None


def _takes_files(folder: Path) -> bool:
    """Whether a file can be made, which rights do not say of read-only disks and of the system's own folders."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError as error:
        return error.errno in (errno.ENOSPC, errno.EDQUOT)  # room may be made until it is needed


def check_file(path: Path, what: str, ours: Collection[str]) -> None:
    """Refuse a file that cannot be written, or that somebody else wrote; its folder may be missing.

    Args:
        path: The file. What is no file, such as a pipe or the terminal, holds nothing to be lost.
        what: Names it in the message: `--json`.
        ours: Texts that each such file of ours holds.
    Raises:
        InputError: It is a folder, its folder cannot be written, or it holds something else.
    """
    if os.path.isdir(path):
        raise InputError("file-is-folder", f"{what} {path}: is a folder; expected the name of a file")
    check_folder(path.parent, what)
    there, unknown = _nearest(path)
    if unknown is not None:
        wrong = f"{what} {path}: cannot be written ({there}: {unknown})"
        raise InputError("file-unwritable", f"{wrong}; name another file")
    if path.is_file() and path.stat().st_size and not _holds(path, ours):
        wrong = f"{what} {path}: is there and no earlier result of this command"
        raise InputError("file-exists", f"{wrong}; name another file, or move it away")


def _holds(path: Path, texts: Collection[str]) -> bool:
    try:
        with path.open("rb") as file:
            content = file.read(TEXT_BYTES)
    except OSError:
        return False
    return all(text.encode() in content for text in texts)
