"""The lock of a run folder: the living keep it, the dead lose it, on this machine and on others."""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.refused import refused
from tests.waiting import wait_for

from devrf.capture.system.errors import InputError
from devrf.pipelines.run_folder import lock
from devrf.pipelines.run_folder.lock import LOCK, Lock
from devrf.pipelines.run_folder.workspace import Workspace

HOLD = """
import sys, time
from pathlib import Path
from devrf.pipelines.run_folder.lock import Lock
Lock(Path(sys.argv[1])).take()
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator["subprocess.Popen[str]"]:
    """Another process that holds the lock."""
    process = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def says(folder: Path, **changes: object) -> None:
    """A lock of a process of this machine that ended long ago, with some of what it says changed."""
    holder = {"pid": 2**22 + 1, "host": os.uname().nodename, "since": "2026-01-01 00:00:00"}
    holder |= {"boot": Path("/proc/sys/kernel/random/boot_id").read_text().strip()}
    holder |= {"pids": os.readlink("/proc/self/ns/pid")}
    (folder / LOCK).write_text(json.dumps(holder | changes))


def test_a_living_process_keeps_it_and_a_dead_one_does_not(
    tmp_path: Path, holder: "subprocess.Popen[str]"
) -> None:
    with refused("folder-busy", tmp_path, f"process {holder.pid} on ", kind=InputError):
        Lock(tmp_path).take()
    # whatever the file says: containers may have equal process numbers and names, and someone may have emptied it
    for text in (json.dumps({"pid": os.getpid(), "host": "x", "since": "y"}), "{", ""):
        (tmp_path / LOCK).write_text(text)
        with refused("folder-busy", tmp_path, kind=InputError):
            Lock(tmp_path).take()
    holder.kill()
    holder.wait()
    taken = Lock(tmp_path)
    taken.take()
    taken.release()
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "\0" * 200])
def test_one_that_a_power_cut_has_emptied_is_dead(tmp_path: Path, text: str) -> None:
    (tmp_path / LOCK).write_text(text)
    Lock(tmp_path).take()


@pytest.mark.parametrize(
    ("age_s", "waits"), [(3600.0, False), (0.0, True), (-3600.0, True)], ids=["old", "new", "future"]
)
def test_one_of_another_machine_is_dead_when_nobody_touches_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, age_s: float, waits: bool
) -> None:
    """At once where it is old; a time that lies in the future is no reason to wait for longer than a lease."""
    monkeypatch.setattr(lock, "LEASE_S", 0.5)
    monkeypatch.setattr(lock, "POLL_S", 0.05)
    said: list[str] = []
    says(tmp_path, host="node7", boot="another")
    touched = time.time() - age_s
    os.utime(tmp_path / LOCK, (touched, touched))
    start = time.monotonic()
    Lock(tmp_path, said.append).take()
    assert (0.3 < time.monotonic() - start < 5) == waits
    assert len(said) == waits and all("process 4194305 on node7" in line for line in said)


def test_one_of_another_machine_that_is_released_meanwhile_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "POLL_S", 0.05)
    says(tmp_path, host="node7", boot="another")
    taken = Lock(tmp_path, lambda text: (tmp_path / LOCK).unlink())
    taken.take()
    taken.check()
    with refused("folder-busy", kind=InputError):
        Lock(tmp_path).take()


def test_one_of_another_machine_that_is_touched_is_alive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "POLL_S", 0.3)
    says(tmp_path, host="node7", boot="another")
    touches = subprocess.Popen([sys.executable, "-c", f"import os; os.utime({str(tmp_path / LOCK)!r})"])
    with refused("folder-busy", "process 4194305 on node7", kind=InputError):
        Lock(tmp_path).take()
    touches.wait()
    assert json.loads((tmp_path / LOCK).read_text())["host"] == "node7"


def test_a_holder_touches_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT_S", 0.02)
    taken = Lock(tmp_path)
    taken.take()
    os.utime(tmp_path / LOCK, (1, 1))
    wait_for(lambda: (tmp_path / LOCK).stat().st_mtime > 1)
    taken.release()


def test_one_that_a_signal_ends_before_its_first_touch_is_released(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(thread: threading.Thread) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", start)
    with pytest.raises(KeyboardInterrupt), Workspace(tmp_path):
        pass
    assert not (tmp_path / LOCK).exists()


@pytest.mark.parametrize("errno", lock.NO_LOCKS)
@pytest.mark.parametrize("living", [True, False])
def test_without_locks_of_the_file_system_a_lease_decides_and_the_dead_are_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, living: bool, errno: int
) -> None:
    """A living process of this machine keeps the file by touching it; the number of a dead one is known to be free."""

    def flock(handle: int, operation: int) -> None:
        raise OSError(errno, "no locks")

    monkeypatch.setattr("fcntl.flock", flock)
    monkeypatch.setattr(lock, "POLL_S", 0.3)
    if not living:
        says(tmp_path)
        Lock(tmp_path).take()
        return
    says(tmp_path, pid=os.getppid())
    touch = f"import os, time\nwhile True: os.utime({str(tmp_path / LOCK)!r}); time.sleep(0.1)"
    touches = subprocess.Popen([sys.executable, "-c", touch])
    try:
        with refused("folder-busy", f"process {os.getppid()} ", kind=InputError):
            Lock(tmp_path).take()
    finally:
        touches.kill()
        touches.wait()


def test_who_has_lost_it_is_told_and_leaves_it_alone(tmp_path: Path) -> None:
    taken = Lock(tmp_path)
    taken.take()
    taken.check()
    (tmp_path / LOCK).unlink()
    (tmp_path / LOCK).write_text("another's")
    with refused("folder-lock-lost", tmp_path / LOCK):
        taken.check()
    taken.release()
    assert (tmp_path / LOCK).read_text() == "another's"


@pytest.mark.full
def test_of_many_that_start_at_once_one_gets_it(tmp_path: Path) -> None:
    code = HOLD.replace("Lock(", "while time.time() < float(sys.argv[2]): pass\nLock(").replace(
        "sleep(60)", "sleep(2)"
    )
    for _ in range(3):
        begin = str(time.time() + 1.0)
        started = [
            subprocess.Popen(
                [sys.executable, "-c", code, str(tmp_path), begin],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
            )
            for _ in range(4)
        ]
        said = [process.communicate() for process in started]
        assert sorted(out for out, _ in said) == ["", "", "", "held\n"], said
        assert sum(f"InputError: {tmp_path}: " in err for _, err in said) == 3
