"""The run folder: one run at a time, and stages that appear whole or not at all.

A stage writes into `.new-<stage>-...`; when it is complete (its stamp is written last) the folder that it
replaces is renamed to `.old-<stage>-...`, the new one gets the stage's name, and only then the old one is
removed. Whatever kills a run in between, `recover` finds either the old or the new folder whole.
"""

import errno
import json
import os
import secrets
import shutil
import socket
import time
from pathlib import Path

from devrf.capture.errors import DevrfError, InputError
from devrf.pipelines.stamp import STAMP

NEW, OLD = ".new-", ".old-"
LOCK = ".lock"


class DiskFullError(DevrfError):
    """There is no room left where the run folder lies."""


class Workspace:
    """A run folder held by this process.

    Args:
        run_dir: The folder; made where it is missing.
    Raises:
        InputError: It cannot be written, or another run holds it.
        DiskFullError: There is not even room for the lock.
    """

    def __init__(self, run_dir: Path) -> None:
        self.run_dir = run_dir
        self._locked = False

    def __enter__(self) -> "Workspace":
        try:
            self.run_dir.mkdir(parents=True, exist_ok=True)
            self._lock()
            self._recover()
        except OSError as error:
            self.release()
            if is_disk_full(error):
                raise DiskFullError(disk_full_message(self.run_dir, "the run", 0)) from error
            raise InputError(
                f"output: {self.run_dir}: cannot be written ({error.strerror or error}); "
                "choose another folder (output: in scene.yaml) or make it writable"
            ) from error
        except BaseException:
            self.release()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        self.release()

    def release(self) -> None:
        """Let others run here."""
        if self._locked:
            self._locked = False
            (self.run_dir / LOCK).unlink(missing_ok=True)

    def fresh_folder(self, stage: str) -> Path:
        """An empty folder for a stage to write into."""
        folder = self.run_dir / f"{NEW}{stage}-{os.getpid()}-{secrets.token_hex(3)}"
        folder.mkdir()
        return folder

    def commit(self, stage: str, folder: Path) -> None:
        """Give a complete folder the stage's name."""
        _sync_folder(folder)
        finished = self.run_dir / stage
        old = self.run_dir / f"{OLD}{stage}-{secrets.token_hex(3)}"
        if finished.exists():
            finished.rename(old)
        folder.rename(finished)
        _sync_folder(self.run_dir)
        shutil.rmtree(old, ignore_errors=True)

    def discard(self, folder: Path) -> None:
        """Remove what an unfinished stage wrote."""
        shutil.rmtree(folder, ignore_errors=True)

    def _lock(self) -> None:
        path = self.run_dir / LOCK
        with path.open("a+", encoding="utf-8") as file:
            _exclusive(file.fileno())  # two processes that both find a dead run take turns here
            file.seek(0)
            holder = _parse(file.read())
            if holder is not None and _alive(holder):
                raise InputError(
                    f"{self.run_dir}: another run (process {holder['pid']} on {holder['host']}, since "
                    f"{holder['since']}) works in this folder; wait for it, stop it, or use another output"
                )
            file.seek(0)
            file.truncate()
            me = {
                "pid": os.getpid(),
                "host": socket.gethostname(),
                "started": _start_of(os.getpid()),
                "since": time.strftime("%Y-%m-%d %H:%M:%S"),
            }
            json.dump(me, file)
            file.flush()
            self._locked = True
            if not path.exists() or os.fstat(file.fileno()).st_ino != path.stat().st_ino:
                self._locked = False  # released between open and lock: the name is another file now
        if not self._locked:
            self._lock()

    def _recover(self) -> None:
        """Put right what a killed run left: a swap half done, folders never finished."""
        for old in self.run_dir.glob(f"{OLD}*"):
            stage = old.name.removeprefix(OLD).rsplit("-", 1)[0]
            finished = self.run_dir / stage
            if not finished.exists():
                complete = [f for f in self.run_dir.glob(f"{NEW}{stage}-*") if (f / STAMP).is_file()]
                (complete[0] if complete else old).rename(finished)
        for leftover in (*self.run_dir.glob(f"{NEW}*"), *self.run_dir.glob(f"{OLD}*")):
            shutil.rmtree(leftover, ignore_errors=True)
        for leftover in self.run_dir.glob(".*.tmp"):
            leftover.unlink(missing_ok=True)


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
    """Free bytes where a folder lies or would lie."""
    for place in (folder, *folder.parents):
        try:
            return shutil.disk_usage(place).free
        except OSError:
            continue
    return None


def size_of(folder: Path) -> int:
    """Bytes of all files below a folder."""
    total = 0
    for root, _, files in os.walk(folder):
        for name in files:
            try:
                total += os.lstat(os.path.join(root, name)).st_size
            except OSError:
                pass
    return total


def _sync_folder(folder: Path) -> None:
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return  # not every system opens folders
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)


def _exclusive(handle: int) -> None:
    try:
        import fcntl
    except ImportError:
        return  # no such lock on this system; the process number still protects
    fcntl.flock(handle, fcntl.LOCK_EX)


def _parse(text: str) -> dict | None:
    try:
        holder = json.loads(text)
    except ValueError:
        return None
    return holder if isinstance(holder, dict) and {"pid", "host", "since"} <= holder.keys() else None


def _alive(holder: dict) -> bool:
    """Whether the process in a lock still runs. On another host nobody can tell: then yes."""
    if holder["host"] != socket.gethostname():
        return True
    if holder["pid"] == os.getpid():
        return False
    try:
        os.kill(holder["pid"], 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return holder.get("started") == _start_of(holder["pid"])  # numbers are used again


def _start_of(pid: int) -> str | None:
    """When a process started, in the kernel's ticks; None where it cannot be known or is a zombie."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except (OSError, IndexError):
        return None
    return "dead" if fields[0] == "Z" else fields[19]
