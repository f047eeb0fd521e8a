"""The run folder: one run at a time, and stages that appear whole or not at all.

A stage writes into `.new-<stage>-...`; when it is complete (its stamp is written last) and lies on the disk, the folder
that it replaces is renamed to `.old-<stage>-...`, the new one gets the stage's name, and only then the old one is
removed. Whatever ends a run in between, a power cut too, `_recover` finds either the old or the new folder whole.
"""

import errno
import os
import re
import secrets
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from devrf.capture.system.durable import sync, sync_tree
from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.limits import TEXT_BYTES
from devrf.capture.system.remove import remove_tree
from devrf.pipelines.run_folder.lock import Lock
from devrf.pipelines.run_folder.own_folder import is_run_folder
from devrf.pipelines.stamps.stamp import STAMP

NEW, OLD = ".new-", ".old-"
OURS = re.compile(  # hidden files and folders that are put right or removed
    rf"{re.escape(NEW)}(?P<new>\w+)-\d+-[0-9a-f]{{6}}"
    rf"|{re.escape(OLD)}(?P<old>\w+)-[0-9a-f]{{6}}"
    r"|(?P<part>\.(digests\.json\.\d+|failed-\w+\.json\.\d+|\w+(\..+)?\.safetensors)\.tmp)"
    r"|\.(?P<trained>\w+)(\..+)?\.safetensors"
)
LOGS = "logs"  # what native programs said in stages that did not succeed


class Workspace:
    """A run folder held by this process.

    Args:
        run_dir: The folder; made where it is missing.
        say: Told what it waits for.
    Raises:
        InputError: It cannot be written, or another run holds it.
        DevrfError: There is not even room for the lock.
    """

    def __init__(self, run_dir: Path, say: Callable[[str], None] = lambda text: None) -> None:
        self.run_dir = run_dir
        self._lock = Lock(run_dir, say)

    def __enter__(self) -> "Workspace":
        try:
            self.run_dir.mkdir(parents=True, exist_ok=True)
            self._lock.take()
            self._recover()
        except OSError as error:
            self._lock.release()
            if is_disk_full(error):
                raise DevrfError("disk-full", disk_full_message(self.run_dir, "the run", 0)) from error
            raise InputError(
                "folder-unwritable",
                f"output: {self.run_dir}: cannot be written ({error.strerror or error}); "
                "choose another folder (output: in scene.yaml) or make it writable",
            ) from error
        except BaseException:
            self._lock.release()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self._lock.release()

    def new_folder(self, stage: str) -> Path:
        """The path of a folder for a stage to write into: known before it is made, so that it can always be removed."""
        return self.run_dir / f"{NEW}{stage}-{os.getpid()}-{secrets.token_hex(3)}"

    def commit(self, stage: str, folder: Path) -> None:
        """Give a complete folder the stage's name.

        Raises:
            DevrfError: The lock is no longer held.
            OSError: The folder does not get onto the disk.
        """
        sync_tree(folder)
        self._lock.check()
        finished = self.run_dir / stage
        old = self.run_dir / f"{OLD}{stage}-{secrets.token_hex(3)}"
        if finished.exists():
            finished.rename(old)
        folder.rename(finished)
        sync(self.run_dir)
        _remove(old)
        for log in (self.run_dir / LOGS).glob(f"{stage}-*.log"):
            log.unlink(missing_ok=True)

    def discard(self, folder: Path) -> list[Path]:
        """Remove what an unfinished stage wrote, but for the logs of native programs; where those are now."""
        stage = folder.name.removeprefix(NEW).split("-", 1)[0]
        kept = []
        for log in sorted(folder.glob("*.log")):
            place = self.run_dir / LOGS / f"{stage}-{log.name}"
            try:
                place.parent.mkdir(exist_ok=True)
                kept.append(log.replace(place))
            except OSError:
                pass  # a full disk takes the log too
        _remove(folder)
        return kept

    def _recover(self) -> None:
        """Put right what a killed run left: a swap half done, folders never finished. What others put here stays."""
        if not is_run_folder(self.run_dir):
            return
        here = {path: OURS.fullmatch(path.name) for path in self.run_dir.glob(".*")}
        olds = {path: match["old"] for path, match in here.items() if match and match["old"]}
        news = {path: match["new"] for path, match in here.items() if match and match["new"]}
        for old, stage in olds.items():
            finished = self.run_dir / stage
            if not finished.exists():  # a new one lay on the disk before the old one was renamed
                whole = [f for f in (*news, old) if stage == news.get(f, stage) and (f / STAMP).is_file()]
                (whole or [old])[0].rename(finished)
        for leftover in filter(Path.exists, news):
            self.discard(leftover)
        for leftover in filter(Path.exists, olds):
            _remove(leftover)
        for path, match in here.items():
            if match and match["part"]:
                path.unlink(missing_ok=True)
            if match and match["trained"]:  # a training whose stage has been finished since
                stamp = self.run_dir / match["trained"] / STAMP
                ended = stamp.is_file() and stamp.stat().st_mtime_ns >= path.stat().st_mtime_ns
                if ended and _is_checkpoint(path):
                    path.unlink()


def is_disk_full(error: BaseException) -> bool:
    """Whether an error, or what caused it, says that a disk is full."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        if isinstance(current, OSError) and current.errno in (errno.ENOSPC, errno.EDQUOT):
            return True
        if "no space left on device" in str(current).lower():
            return True
        current = current.__cause__ or current.__context__
    return False


def disk_full_message(folder: Path, what: str, written: int) -> str:
    """What a full disk says: folder, what is free, what was needed so far, and what to do."""
    free = free_bytes(folder)
    free_text = "unknown" if free is None else f"{free / 1e6:.1f} MB"
    return (
        f"{folder}: the disk is full ({free_text} free; {what} needs more than {written / 1e6:.1f} MB); "
        "free some space or set output: in scene.yaml to a folder on a larger disk, then run again: "
        "finished stages are kept"
    )


def free_bytes(folder: Path) -> int | None:
    """Free bytes where a folder lies or would lie; None where the disk does not tell."""
    try:
        return shutil.disk_usage(nearest(folder)).free
    except OSError:
        return None


def nearest(folder: Path) -> Path:
    """A folder, or the nearest one above it that is there."""
    place = folder.absolute()
    return next(above for above in (place, *place.parents) if above.exists())


def size_of(path: Path) -> int:
    """Bytes of a file, or of all files below a folder."""
    below = (os.path.join(root, name) for root, _, files in os.walk(path) for name in files)
    total = 0
    for file in below if path.is_dir() else [path]:
        with suppress(OSError):
            total += os.lstat(file).st_size
    return total


def _is_checkpoint(path: Path) -> bool:
    """Whether a file is one of ours, by its head (safetensors: the length of the names in JSON, then these)."""
    with path.open("rb") as file:
        head = file.read(min(int.from_bytes(file.read(8), "little"), TEXT_BYTES))
    return b'"__metadata__"' in head and b'"devrf"' in head


def _remove(folder: Path) -> None:
    """Remove a folder, the stamp first: what is left of it by a kill counts as nothing."""
    with suppress(OSError):  # what cannot be removed is the next run's
        (folder / STAMP).unlink()
    remove_tree(folder)
