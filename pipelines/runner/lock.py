"""One run at a time in a folder, also where several machines share its disk.

`.lock` says who works here. On one machine the kernel knows best: the holder keeps the file locked (flock), which ends
with the process however that ends, and whatever process numbers and host names containers see. Some network file
systems do not pass such locks on (NFS with `nolock` or `local_lock`): there the holder shows that it lives by touching
the file. A lock of another machine that was not touched for `LEASE_S`, by the file system's own clock, is a dead one's.
"""

import errno
import fcntl
import json
import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

from devrf.capture.errors import DevrfError, InputError

LOCK = ".lock"
BEAT_S = 10.0  # between two touches
LEASE_S = 60.0  # six missed touches: a busy server delays one or two
POLL_S = 1.0  # between two looks at the lock of another machine


class Lock:
    """The lock of a run folder.

    Args:
        folder: The run folder; exists.
        say: Told why it takes long, where it does.
    """

    def __init__(self, folder: Path, say: Callable[[str], None] = lambda text: None) -> None:
        self._path, self._say = folder / LOCK, say
        self._handle: int | None = None
        self._released = threading.Event()
        self._beats = threading.Thread(target=self._beat, name="lock", daemon=True)

    def take(self) -> None:
        """Take the lock; that of a dead process is taken over.

        Raises:
            InputError: Another run holds it.
        """
        while self._handle is None:
            handle, new = self._open()
            try:
                known = _lock(handle)
                if known is False:
                    raise self._busy(_holder(handle))
                if not _same_file(self._path, handle):
                    os.close(handle)  # released between open and lock: the name is another file now
                    continue
                if not new:
                    self._wait_for_the_dead(handle, kernel_knows=known is True)
                _write(handle, _me())
            except BaseException as error:
                if new and not isinstance(error, InputError):
                    self._path.unlink(missing_ok=True)
                os.close(handle)
                raise
            self._handle = handle
        self._beats.start()

    def check(self) -> None:
        """Make sure that this process still holds the lock.

        Raises:
            DevrfError: It slept so long that another machine has taken it for dead, or someone removed the file.
        """
        if self._handle is None or not _same_file(self._path, self._handle):
            raise DevrfError(
                f"{self._path}: is no longer this run's (it was removed, or taken over by another run); "
                "nothing more is written here; run again when no other run works in this folder"
            )

    def release(self) -> None:
        """Let others run here."""
        if self._handle is None:
            return
        self._released.set()
        self._beats.join(1.0)  # at once, unless a server does not answer
        if _same_file(self._path, self._handle):
            self._path.unlink(missing_ok=True)
        os.close(self._handle)
        self._handle = None

    def _open(self) -> tuple[int, bool]:
        """A handle, and whether the file is new."""
        while True:
            try:
                return os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666), True
            except FileExistsError:
                pass
            try:
                return os.open(self._path, os.O_RDWR), False
            except FileNotFoundError:
                continue  # released meanwhile

    def _wait_for_the_dead(self, handle: int, *, kernel_knows: bool) -> None:
        """Return when the holder is known to be dead.

        Raises:
            InputError: It lives.
        """
        holder, me = _holder(handle), _me()
        here = holder is None or (holder["host"], holder.get("boot")) == (me["host"], me["boot"])
        if kernel_knows and here:
            return  # a living holder would have it locked
        if holder is not None and here and holder.get("pids") == me["pids"] and me["started"]:
            if holder.get("started") == _start_of(holder["pid"]):  # numbers are used again
                raise self._busy(holder)
            return
        touched = os.fstat(handle).st_mtime_ns
        first = True
        while (age_s := (self._file_system_ns() - touched) / 1e9) < LEASE_S:
            if os.fstat(handle).st_mtime_ns != touched:
                raise self._busy(holder)
            if first:
                self._say(
                    f"{self._path}: held by {_named(holder)}, last sign of life {max(age_s, 0):.0f} s ago; "
                    f"waiting for another, or until {LEASE_S:.0f} s are over"
                )
            first = False
            time.sleep(POLL_S)

    def _file_system_ns(self) -> int:
        """What time it is where the folder lies."""
        probe = self._path.with_name(f"{LOCK}.{os.getpid()}.tmp")
        probe.touch()
        now = probe.stat().st_mtime_ns
        probe.unlink()
        return now

    def _busy(self, holder: dict | None) -> InputError:
        return InputError(
            f"{self._path.parent}: another run ({_named(holder)}) works in this folder; wait for it, stop it, or "
            "use another output"
        )

    def _beat(self) -> None:
        while not self._released.wait(BEAT_S):
            handle = self._handle
            try:
                if handle is not None:
                    os.utime(handle)
            except OSError:
                pass  # a server that does not answer for a while


def is_held(folder: Path) -> bool:
    """Whether a run seems to work in a folder, by reading alone: for those who only look.

    A lock left by a process that was killed counts for `LEASE_S`, unless it is known here that the process is gone.
    """
    try:
        handle = os.open(folder / LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        holder, me = _holder(handle), _me()
        if holder is not None and all(holder.get(key) == me[key] for key in ("host", "boot", "pids")):
            return holder.get("started") == _start_of(holder["pid"])
        return time.time() - os.fstat(handle).st_mtime < LEASE_S
    finally:
        os.close(handle)


def _lock(handle: int) -> bool | None:
    """Have the kernel lock a file. False where another process has it; None where this cannot be done."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
            return None
        raise
    return True


def _same_file(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _me() -> dict:
    """What a lock says of its holder."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "started": _start_of(os.getpid()),
        "boot": _text("/proc/sys/kernel/random/boot_id"),
        "pids": _link("/proc/self/ns/pid"),
        "since": time.strftime("%Y-%m-%d %H:%M:%S"),
    }


def _write(handle: int, holder: dict) -> None:
    os.ftruncate(handle, 0)
    os.pwrite(handle, json.dumps(holder).encode(), 0)
    os.fsync(handle)


def _holder(handle: int) -> dict | None:
    """Who a lock names; None where it is empty or cannot be read, as after a power cut."""
    try:
        holder = json.loads(os.pread(handle, 65536, 0))
    except ValueError:
        return None
    return holder if isinstance(holder, dict) and {"pid", "host", "since"} <= holder.keys() else None


def _named(holder: dict | None) -> str:
    return (
        "unknown"
        if holder is None
        else f"process {holder['pid']} on {holder['host']}, since {holder['since']}"
    )


def _start_of(pid: int) -> str | None:
    """When a process started, in the kernel's ticks; None where it is gone, a zombie, or cannot be known."""
    fields = (_text(f"/proc/{pid}/stat") or "").rpartition(")")[2].split()
    return None if len(fields) < 20 or fields[0] in "ZX" else fields[19]


def _text(path: str) -> str | None:
    try:
        return Path(path).read_text().strip()
    except (OSError, ValueError):
        return None


def _link(path: str) -> str | None:
    try:
        return os.readlink(path)
    except OSError:
        return None
