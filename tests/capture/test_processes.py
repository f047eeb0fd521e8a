"""Processes that end with their parent, and what a process and its descendants take of memory."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from devrf.capture.system.processes import descendants, memory_of, run_module

TIED = """
import os, sys, time
from devrf.capture.system.processes import die_with_parent
die_with_parent(int(sys.argv[1]))
print(os.getpid(), flush=True)
time.sleep(60)
"""
STARTER = f"""
import os, subprocess, sys
subprocess.run([sys.executable, "-c", {TIED!r}, str(os.getpid())])
"""
HOLDS = "held = bytearray(b'x') * 50_000_000; print('held', flush=True); import time; time.sleep(60)"


@pytest.fixture
def started() -> Iterator[list["subprocess.Popen[str]"]]:
    """Processes to end after the test."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


def start(code: str, started: list["subprocess.Popen[str]"], *arguments: str) -> tuple[int, str]:
    """Start a program; its process number and the first line it prints."""
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, text=True)
    started.append(process)
    assert process.stdout is not None
    return process.pid, process.stdout.readline().strip()


def gone(pid: int) -> bool:
    deadline = time.monotonic() + 5
    while time.monotonic() < deadline:
        if pid not in (int(p.name) for p in Path("/proc").glob("[0-9]*")) or "State:\tZ" in status(pid):
            return True
        time.sleep(0.01)
    return False


def status(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return "State:\tZ"


def test_a_process_ends_with_its_parent(started: list["subprocess.Popen[str]"]) -> None:
    parent, said = start(STARTER, started)
    tied = int(said)
    assert tied in descendants(parent) and tied in descendants(os.getpid())
    started[0].kill()
    started[0].wait()
    assert gone(tied)


def test_one_whose_parent_is_gone_already_ends_at_once(started: list["subprocess.Popen[str]"]) -> None:
    assert start(TIED, started, "1")[1] == ""
    assert started[0].wait() == -9


def test_a_module_is_not_looked_for_where_it_is_called(tmp_path: Path) -> None:
    for name in ("json", "devrf", "runpy", "numpy"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('code of a capture was run')")
    words = ["-c", "import sys, json; print(json.loads('[1]'), sys.argv)"]
    assert b"was run" in subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True).stderr
    (tmp_path / "in.json").write_text("[1]")
    done = subprocess.run(run_module("json.tool", "in.json"), cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["[", "1", "]"], done.stderr
    worker = run_module("devrf.calibration.sweep.sfm_worker", "in.json")
    assert "was run" not in subprocess.run(worker, cwd=tmp_path, capture_output=True, text=True).stderr


def test_the_worker_of_structure_from_motion_is_tied(tmp_path: Path) -> None:
    (tmp_path / "job.json").write_text(json.dumps({"parent": 1, "task": "extract"}))
    worker = [sys.executable, "-m", "devrf.calibration.sweep.sfm_worker", str(tmp_path / "job.json")]
    assert subprocess.run(worker, capture_output=True).returncode == -9


@pytest.mark.parametrize("shared_once", [False, True])
def test_memory_is_what_processes_hold(started: list["subprocess.Popen[str]"], shared_once: bool) -> None:
    holder, said = start(HOLDS, started)
    assert said == "held"
    assert 50e6 < memory_of([holder], shared_once=shared_once) < 75e6
    assert memory_of([], shared_once=shared_once) == memory_of([2**22 + 1], shared_once=shared_once) == 0


def test_memory_that_is_shared_counts_once(started: list["subprocess.Popen[str]"]) -> None:
    pid, said = start(HOLDS.replace("print", "import os; os.fork() and print"), started)
    assert said == "held"
    both = [pid, *descendants(pid)]
    try:
        assert memory_of(both) > 100e6
        assert memory_of(both, shared_once=True) < 80e6
    finally:
        os.kill(both[1], 9)
