"""Content digests of files, taken at the speed of the disk and remembered.

A digest is remembered with size, both times and inode of its file, and trusted only while these are the same: reading
gigabytes again to learn that nothing changed would make a run that does nothing slow. Where they differ, or could be
the same although the content is not (below), the file is read again; only content counts.
"""

import errno
import hashlib
import os
import re
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from devrf.capture.system.durable import read_json, write_json
from devrf.capture.system.errors import InputError
from devrf.pipelines.terminal.logs import LOG_FILE

DIGESTS = ".digests.json"  # in the run folder
DROPPED = re.compile(  # names of files that macOS, Windows, desktops, NFS and editors drop; no stage reads them
    r"\.DS_Store|\._.*|(eh)?thumbs\.db|desktop\.ini|\.directory|\.nfs[0-9a-f]+|.*~|#.*#|\..*\.sw[a-p]|.*\.(bak|orig)",
    re.IGNORECASE,
)
BLOCK = 1 << 20  # bytes per read: as quick as larger ones, and stays in the processor's cache
READERS = 4  # files read side by side: hashing releases the interpreter, and disks like a queue
FEW = 8  # files that are read one by one: threads would cost more than they save
RACY_S = 3.0  # times of FAT have steps of 2 s, those of NFS may lag as much as its cache of attributes, 3 s

DIGEST = 5  # where it stands in what is remembered of a file

Seen = tuple[int, int, int, int]
"""Size, modification time, change time (ns) and inode. Not the device: its number changes with every mount of a USB or
network disk, and no two files at one path share the other four."""


class Digests:
    """Digests of files, remembered in the run folder.

    A remembered digest counts only if the file was at rest when it was taken: last changed more than RACY_S before.
    Else a change in the same tick of the clock, on a file system with coarse times, or under a clock that was set back
    would go unseen.

    Args:
        run_dir: The run folder; paths are kept relative to it, so that they stay true where all is moved together.
    """

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._path = run_dir / DIGESTS
        self._known: dict[str, list] = _read(self._path)
        self._changed = False

    def of(self, path: Path) -> str:
        """Digest of a file's content, or of the names and contents of all files in a folder.

        Run folders inside it are left out: a run that lies in its own data set must not make itself stale.
        """
        if not path.is_dir():
            return self.of_files([path])[0]
        files = raw_files(path)
        digest = hashlib.blake2b(digest_size=16)
        for file, content in zip(files, self.of_files(files), strict=True):
            digest.update(f"{file.relative_to(path).as_posix()}\0{content}\0".encode())
        return digest.hexdigest()

    def of_files(self, paths: Iterable[Path]) -> list[str]:
        """Digest of each file's content.

        Raises:
            InputError: A file cannot be read.
        """
        paths = list(paths)
        keys = [os.path.relpath(path, self._run_dir) for path in paths]
        unknown = {k: path for k, path in zip(keys, paths, strict=True) if not self._knows(k, path)}
        entries = _entries(list(unknown.values()))
        self._known.update(zip(unknown, entries, strict=True))
        self._changed |= bool(unknown)
        return [self._known[key][DIGEST] for key in keys]

    def renamed(self, old: Path, new: Path) -> None:
        """A folder has another name now: its files are still the same."""
        before, after = (os.path.relpath(path, self._run_dir) + os.sep for path in (old, new))
        moved = {key: entry for key, entry in self._known.items() if key.startswith(before)}
        for key, entry in moved.items():
            del self._known[key]
            self._known[after + key.removeprefix(before)] = entry

    def save(self) -> None:
        """Remember for the next run; a run folder that cannot be written only costs time."""
        if self._changed:
            self._known = {k: entry for k, entry in self._known.items() if (self._run_dir / k).exists()}
            with suppress(OSError):
                write_json(self._path, self._known)
            self._changed = False

    def _knows(self, key: str, path: Path) -> bool:
        entry = self._known.get(key)
        if entry is None:
            return False
        *seen, taken, _ = entry
        at_rest = max(seen[1:3]) + RACY_S * 1e9 < taken <= time.time_ns()
        try:
            return at_rest and tuple(seen) == _seen(path.stat())
        except OSError:
            return False  # reading it will say why


def file_digest(path: Path) -> str:
    """Digest of a file's content, 32 hexadecimal digits.

    Raises:
        InputError: The disk or card that it lies on cannot give it.
        OSError: It cannot be read for another reason.
    """
    digest = hashlib.blake2b(digest_size=16)
    try:
        with path.open("rb", buffering=0) as file:
            block = memoryview(bytearray(min(BLOCK, os.fstat(file.fileno()).st_size + 1)))
            while count := file.readinto(block):
                digest.update(block[:count])
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        text = f"{path}: cannot be read to its end ({error.strerror}); copy it from another disk"
        raise InputError("file-unreadable", text) from None
    return digest.hexdigest()


def _entries(paths: list[Path]) -> list[list]:
    """What is remembered of each file; many are read side by side."""
    if len(paths) <= FEW:
        return [_entry(path) for path in paths]
    with ThreadPoolExecutor(READERS) as pool:
        return list(pool.map(_entry, paths))


def _entry(path: Path) -> list:
    """[size, modified, changed, inode, taken (ns), digest]: what is remembered of a file."""
    try:
        taken, seen = time.time_ns(), _seen(path.stat())
        digest = file_digest(path)
        if _seen(path.stat()) != seen:  # written to meanwhile: true of no moment, so never trusted
            taken = 0
    except OSError as error:
        text = f"{path}: cannot be read ({error.strerror or error}); check the file, its permissions and its disk"
        raise InputError("file-unreadable", text) from error
    return [*seen, taken, digest]


def _seen(stat: os.stat_result) -> Seen:
    return stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino


def _read(path: Path) -> dict[str, list]:
    """What was remembered; nothing where the file is damaged or of an earlier version."""
    try:
        known = read_json(path)
    except (OSError, ValueError):
        return {}
    if not isinstance(known, dict):
        return {}
    kinds = (int, int, int, int, int, str)
    return {
        key: entry
        for key, entry in known.items()
        if isinstance(entry, list) and tuple(map(type, entry)) == kinds
    }


def raw_files(folder: Path) -> list[Path]:
    """All files below a folder, in order, that can be anything of the user's.

    Not so those of runs (known by log or digests), and what systems and editors leave.
    """
    found = []
    for root, folders, files in os.walk(folder):
        here = Path(root)
        folders[:] = [
            name
            for name in folders
            if not any((here / name / mark).is_file() for mark in (LOG_FILE, DIGESTS))
        ]
        found += [file for name in files if not DROPPED.fullmatch(name) and (file := here / name).is_file()]
    return sorted(found)
