"""Faults at an exact point of a run: Python says before it opens, renames, makes or removes a file (audit events).

Installed in the child process of a run. Events that change something in the run folder are counted, calls that put
files on the disk too; at the n-th the fault happens. What was put on the disk is noted, so that a power cut can be
imitated: names are kept in their order, as journals of file systems do, content that was not on the disk is lost.
"""

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from devrf.capture.system import durable

CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink"}
WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
LOSSES = ("empty", "half", "zeros")


def install(run_dir: Path, at: int, victims: str, signal_name: str, on_disk: Path | None) -> None:
    """Have a signal sent at the n-th change below a folder.

    Args:
        run_dir: The folder.
        at: The number of the change before which it happens, from 1.
        victims: `child` (this process), `parent` or `both`.
        signal_name: Such as SIGKILL.
        on_disk: File for a line (inode, size, time of change) of everything put on the disk.
    """
    counted = 0
    sign = signal.Signals[signal_name]

    def count() -> None:
        nonlocal counted
        counted += 1
        if counted == at:
            for pid in {
                "child": [os.getpid()],
                "parent": [os.getppid()],
                "both": [os.getppid(), os.getpid()],
            }[victims]:
                os.kill(pid, sign)
            if sign == signal.SIGKILL:
                time.sleep(5)  # whatever is to happen now has happened

    def heard(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            changes = isinstance(arguments[2], int) and arguments[2] & WRITES and _below(arguments[0])
        else:
            changes = event in CHANGES and (any(map(_below, arguments)) or _in_open_folder(event, arguments))
        if changes:
            count()

    def _below(path: object) -> bool:
        return isinstance(path, str | os.PathLike) and os.fspath(path).startswith(str(run_dir))

    def _in_open_folder(event: str, arguments: tuple[Any, ...]) -> bool:
        return (
            event in ("os.remove", "os.rmdir") and arguments[-1] >= 0
        )  # by name in a folder that is open: rmtree

    fsync, whole = os.fsync, durable.sync_file_system

    def noted_fsync(handle: int) -> None:
        count()
        fsync(handle)
        _note(on_disk, [os.fstat(handle)])

    def noted_whole(folder: Path) -> bool:
        count()
        done = whole(folder)
        _note(on_disk, [path.stat() for path in run_dir.rglob("*") if path.is_file()])
        return done

    os.fsync, durable.sync_file_system = noted_fsync, noted_whole
    sys.addaudithook(heard)


def lose_what_was_not_on_disk(run_dir: Path, on_disk: Path, rng: random.Random) -> int:
    """Do to a folder what a power cut does; the number of files that lost their content."""
    safe = set(on_disk.read_text().splitlines()) if on_disk.exists() else set()
    lost = 0
    for path in run_dir.rglob("*"):
        if not path.is_file() or _line(path.stat()) in safe or rng.random() < 0.3:
            continue
        size = path.stat().st_size
        loss: Callable[[], Any] = {
            "empty": lambda path=path: os.truncate(path, 0),
            "half": lambda path=path, size=size: os.truncate(path, size // 2),
            "zeros": lambda path=path, size=size: path.write_bytes(bytes(size)),
        }[rng.choice(LOSSES)]
        loss()
        lost += 1
    return lost


def _note(on_disk: Path | None, stats: list[os.stat_result]) -> None:
    if on_disk is not None:
        with on_disk.open("a") as file:
            file.writelines(f"{_line(stat)}\n" for stat in stats)


def _line(stat: os.stat_result) -> str:
    return f"{stat.st_ino} {stat.st_size} {stat.st_mtime_ns}"
