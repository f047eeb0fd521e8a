"""One run at a time in a folder, also where several machines share its disk.

`.lock` says who works here. On one machine the kernel knows best: the holder keeps the file locked (filelock, by
flock), which ends with the process however that ends, and whatever process numbers and host names containers see. Some
network file systems do not pass such locks on (NFS with `nolock` or `local_lock`), and some have none: there the file
is a lease, and its holder shows that it lives by touching it. A lease of another machine that was not touched for
`LEASE_S` is a dead one's: by the file system's own clock, or by ours from when we first saw it, whichever is sooner.
"""

import errno
import json
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from devrf.capture.system.durable import read_json
from devrf.capture.system.errors import DevrfError, InputError

if TYPE_CHECKING:
    from filelock import FileLock

LOCK = ".lock"
BEAT_S = 10.0  # between two touches
LEASE_S = 60.0  # six missed touches: a busy server delays one or two
POLL_S = 1.0  # between two looks at the lock of another machine
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL)  # of file systems without them


class Lock:
    """The lock of a run folder.

    Args:
        folder: The run folder; exists.
        say: Told why it takes long, where it does.
    """

    def __init__(self, folder: Path, say: Callable[[str], None] = lambda text: None) -> None:
        self._path, self._say = folder / LOCK, say
        self._kernels: FileLock | None = None
        self._me: dict[str, Any] | None = None  # what the file says while it is ours
        self._released = threading.Event()
        self._beats = threading.Thread(target=self._beat, name="lock", daemon=True)

    def take(self) -> None:
        """Take the lock; that of a dead process is taken over.

        Raises:
            InputError: Another run holds it.
        """
        self._kernels, kernel_knows = self._of_the_kernel()
        try:
            holder = _holder(self._path)
            if holder is not None and not (kernel_knows and _machine(holder) == _machine(_myself())):
                self._wait_for_the_dead(holder)
            self._write(_myself())
        except FileNotFoundError:  # released meanwhile: the name will be another file
            self._kernels.release()
            return self.take()
        except BaseException:
            self._kernels.release()
            raise
        self._beats.start()

    def check(self) -> None:
        """Make sure that this process still holds the lock.

        Raises:
            DevrfError: It slept so long that another machine has taken it for dead, or someone removed the file.
        """
        if self._me is None or _holder(self._path) != self._me:
            raise DevrfError(
                "folder-lock-lost",
                f"{self._path}: is no longer this run's (it was removed, or taken over by another run); "
                "nothing more is written here; run again when no other run works in this folder",
            )

    def release(self) -> None:
        """Let others run here."""
        if self._me is None or self._kernels is None:
            return
        self._released.set()
        if self._beats.is_alive():  # a signal may have come before it was started
            self._beats.join(1.0)  # at once, unless a server does not answer
        with suppress(OSError):  # the disk is gone, or read-only now: the lock is a dead one's soon
            if _holder(self._path) == self._me:
                self._path.unlink(missing_ok=True)
        self._kernels.release()
        self._me = None

    def _of_the_kernel(self) -> "tuple[FileLock, bool]":
        """The file, locked where the file system knows locks, and whether it does.

        Raises:
            InputError: Another process of this machine has it locked.
        """
        from filelock import FileLock, Timeout

        lock = FileLock(self._path, timeout=0, thread_local=False, fallback_to_soft=False)
        try:
            lock.acquire()
        except Timeout:
            raise self._busy(_holder(self._path)) from None
        except OSError as error:
            if error.errno not in NO_LOCKS:
                raise
            self._path.touch()
            return lock, False
        return lock, True

    def _write(self, me: dict[str, Any]) -> None:
        with self._path.open("r+") as file:
            try:
                file.truncate()
                file.write(json.dumps(me))
            except BaseException:
                self._path.unlink(missing_ok=True)
                raise
        self._me = me

    def _wait_for_the_dead(self, holder: dict[str, Any]) -> None:
        """Return when the holder is known to be dead.

        Raises:
            InputError: It lives.
            FileNotFoundError: It has released the lock.
        """
        if _has_ended(holder):
            return
        touched = self._path.stat().st_mtime_ns
        with tempfile.TemporaryFile(dir=self._path.parent) as probe:  # what time it is where the folder lies
            age_s = min(max((os.fstat(probe.fileno()).st_mtime_ns - touched) / 1e9, 0.0), LEASE_S)
        until = time.monotonic() + LEASE_S - age_s
        if age_s < LEASE_S:
            self._say(
                f"{self._path}: held by {_named(holder)}, last sign of life {age_s:.0f} s ago; "
                f"waiting for another, or until {LEASE_S:.0f} s are over"
            )
        while time.monotonic() < until:
            time.sleep(POLL_S)
            if self._path.stat().st_mtime_ns != touched:
                raise self._busy(holder)

    def _busy(self, holder: dict[str, Any] | None) -> InputError:
        return InputError(
            "folder-busy",
            f"{self._path.parent}: another run ({_named(holder)}) works in this folder; wait for it, stop it, or "
            "use another output",
        )

    def _beat(self) -> None:
        while not self._released.wait(BEAT_S):
            try:
                if _holder(self._path) == self._me:
                    os.utime(self._path)
            except OSError:
                pass  # a server that does not answer for a while


def is_held(folder: Path) -> bool:
    """Whether a run seems to work in a folder, by reading alone: for those who only look.

    A lock left by a process that was killed counts for `LEASE_S`, unless it is known here that the process is gone.
    """
    try:
        age_s, holder = time.time() - (folder / LOCK).stat().st_mtime, _holder(folder / LOCK)
    except OSError:
        return False
    return age_s < LEASE_S and not (holder is not None and _has_ended(holder))


def is_lock(path: Path) -> bool:
    """Whether a file is a lock of ours; one that was only just made is empty."""
    return path.is_file() and (path.stat().st_size == 0 or _holder(path) is not None)


def _myself() -> dict[str, Any]:
    """What a lock says of its holder."""
    return {
        "pid": os.getpid(),
        "host": socket.gethostname(),
        "boot": _known(lambda: Path("/proc/sys/kernel/random/boot_id").read_text().strip()),
        "pids": _known(lambda: os.readlink("/proc/self/ns/pid")),
        "since": time.strftime("%Y-%m-%d %H:%M:%S"),
    }


def _holder(path: Path) -> dict[str, Any] | None:
    """Who a lock names; None where there is none, or it is empty or cannot be read, as after a power cut."""
    try:
        holder = read_json(path)
    except (FileNotFoundError, ValueError):
        return None
    return holder if isinstance(holder, dict) and {"pid", "host", "since"} <= holder.keys() else None


def _named(holder: dict[str, Any] | None) -> str:
    if holder is None:
        return "unknown"
    return f"process {holder['pid']} on {holder['host']}, since {holder['since']}"


def _machine(holder: dict[str, Any]) -> str:
    """Containers of one machine have names of their own, but one start."""
    return holder.get("boot") or holder["host"]


def _has_ended(holder: dict[str, Any]) -> bool:
    """Whether it is known here that a process is gone: one of this machine whose number means the same here."""
    me = _myself()
    if any(holder.get(key) != me[key] for key in ("host", "boot", "pids")):
        return False
    import psutil

    try:
        return psutil.Process(holder["pid"]).status() == psutil.STATUS_ZOMBIE
    except (psutil.NoSuchProcess, TypeError, ValueError):
        return True


def _known(look: Callable[[], str]) -> str | None:
    try:
        return look()
    except OSError:
        return None
