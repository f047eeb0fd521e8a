"""Processes that end with the one that started them, and what a process and all that it started take of memory.

Linux only; elsewhere nothing is tied, and no memory is counted.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

RUN_MODULE = (
    "import sys; sys.path = [folder for folder in sys.path if folder]; sys.argv.pop(0); "
    "from runpy import run_module; run_module(sys.argv[0], run_name='__main__', alter_sys=True)"
)
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h


def run_module(name: str, *arguments: str) -> list[str]:
    """A command that runs a module of this program, whatever lies in the folder that it is called from.

    `python -m` looks there first: a capture that comes with a json.py would have it run.
    """
    return [sys.executable, "-c", RUN_MODULE, name, *arguments]


def die_with_parent(parent: int, sign: signal.Signals = signal.SIGKILL) -> None:
    """Have this process sent a signal when the one that started it ends, however that ends.

    Args:
        parent: Process number of the parent, taken before this process was started: if it is gone already, the
            kernel will not tell.
        sign: What it is sent.
    """
    if sys.platform != "linux":
        return
    _prctl(PR_SET_PDEATHSIG, sign)
    if os.getppid() != parent:
        os.kill(os.getpid(), sign)


def adopt_orphans() -> None:
    """Become the parent of all descendants whose own parent ends, so that they can be found."""
    if sys.platform == "linux":
        _prctl(PR_SET_CHILD_SUBREAPER, 1)


def descendants(pid: int) -> list[int]:
    """All running processes that a process started, and those started by them, parents first."""
    import psutil

    found = []
    with suppress(psutil.NoSuchProcess):
        for process in psutil.Process(pid).children(recursive=True):
            with suppress(psutil.NoSuchProcess):  # it has ended meanwhile
                if process.status() != psutil.STATUS_ZOMBIE:
                    found.append(process.pid)
    return found


def memory_of(pids: Collection[int], *, shared_once: bool = False) -> int:
    """Bytes of main memory that processes hold and the system cannot take back (no mapped files).

    Args:
        pids: The processes.
        shared_once: Count what several of them share once. Exact, but the kernel has to walk through their pages.
    """
    name, keys = (
        ("smaps_rollup", (b"Pss_Anon:", b"Pss_Shmem:"))
        if shared_once
        else ("status", (b"RssAnon:", b"RssShmem:"))
    )
    total = 0
    for pid in pids:
        try:
            lines = Path(f"/proc/{pid}/{name}").read_bytes().splitlines()
        except OSError:
            continue
        total += sum(int(line.split()[1]) * 1024 for line in lines if line.startswith(keys))
    return total


def _prctl(option: int, value: int) -> None:
    ctypes.CDLL(None).prctl(option, ctypes.c_ulong(value), 0, 0, 0)
