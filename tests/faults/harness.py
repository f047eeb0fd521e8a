"""How the tests call the tiny pipeline (tiny_stages.py) as a program, and what must hold after every fault."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY
from tests.faults.tiny_stages import NAMES, stages

from devrf.pipelines.stamps.stamp import stamp_id
from devrf.pipelines.terminal.exit_codes import DONE

BESIDE = (
    "devrf.log",
    "events.jsonl",
    ".digests.json",
    "logs",
)  # what may lie beside the stages of a run that is done
LIMIT_S = 60  # no fault may hang a run


@dataclass(frozen=True)
class Ended:
    """A run that has ended: exit code (below 0: the signal) and what it and its child said."""

    returncode: int
    stdout: str
    stderr: str


class Started:
    """A run of the tiny pipeline.

    Attributes:
        pid: Number of the process; the parent of the one that works.
        returncode: How it ended, below 0 by a signal; None before that is known.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        pipes = [os.pipe() for _ in range(2)]
        self.pid: int = _ask({"start": list(arguments)}, [write for _, write in pipes])
        for _, write in pipes:
            os.close(write)
        self._said = [open(read, encoding="utf-8") for read, _ in pipes]
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """How it ended, None as long as it has not."""
        if self.returncode is None:
            self.returncode = _ask({"poll": self.pid})
        return self.returncode

    def send_signal(self, sign: int) -> None:
        """Send it a signal, if it is still there."""
        if self.poll() is None:
            os.kill(self.pid, sign)

    def terminate(self) -> None:
        """SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def end(self, timeout: float = LIMIT_S) -> Ended:
        """Wait until it and its child have ended; after the time it is killed."""
        watch = threading.Timer(timeout, self.kill)  # a hang ends, and is seen by its exit code
        watch.start()
        with ThreadPoolExecutor(2) as pool:
            out, err = pool.map(lambda stream: stream.read(), self._said)
        for stream in self._said:
            stream.close()
        while self.poll() is None:
            time.sleep(0.002)
        watch.cancel()
        assert self.returncode is not None
        return Ended(self.returncode, out, err)


@cache
def _server() -> socket.socket:
    ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-m", "tests.faults.tiny_server", str(its.fileno())]
    subprocess.Popen(command, cwd=REPOSITORY, stdin=subprocess.DEVNULL, pass_fds=[its.fileno()])
    its.close()
    return ours


_asking = threading.Lock()


def _ask(request: dict, pipes: Sequence[int] = ()) -> Any:
    with _asking:
        socket.send_fds(_server(), [json.dumps(request).encode()], list(pipes))
        return json.loads(_server().recv(65536))


@dataclass(frozen=True)
class Tiny:
    """A folder with the tiny pipeline's scene.

    Attributes:
        folder: Holds scene.yaml; the run folder is `run` in it.
    """

    folder: Path

    @property
    def run_dir(self) -> Path:
        """The run folder."""
        return self.folder / "run"

    def start(self, *settings: str) -> Started:
        """Start a run."""
        return Started([str(self.folder), *settings])

    def run(self, *settings: str) -> Ended:
        """Run to the end, however that comes."""
        return self.start(*settings).end()

    def at_work(self, stage: str, *settings: str) -> Started:
        """A run that has begun a stage, of which the settings are."""
        started, deadline = self.start(*settings, f"stage={stage}"), time.monotonic() + LIMIT_S
        while not list(self.run_dir.glob(f".new-{stage}-*")):
            assert started.poll() is None and time.monotonic() < deadline, f"{stage} never began"
            time.sleep(0.005)
        return started


@dataclass
class Count:
    """What a series of faults came to."""

    faults: int = 0
    took_effect: int = 0  # the run did not end as an undisturbed one
    finished_before: int = 0  # stages that were finished when a fault came
    used_again: int = 0

    def figures(self) -> dict[str, int]:
        """For `--figures`; a test that comes to this has found nothing lost and nothing made twice."""
        return asdict(self)


def go_on(tiny: Tiny, reference: Path, count: Count, *settings: str) -> None:
    """Run to the end after a fault, and check that nothing was lost and nothing was made twice.

    Args:
        tiny: The folder after the fault.
        reference: Run folder of an undisturbed run.
        count: Added to.
        settings: Of the run.
    """
    before = finished(tiny.run_dir)
    result = tiny.run(*settings)
    assert result.returncode == DONE, result.stderr
    made = [
        line.split()[1].rstrip(":")
        for line in result.stdout.splitlines()
        if "] " in line and ": runs:" in line
    ]
    assert made == [name for name in NAMES if name not in before], (made, before, result.stdout)
    after = {name: stamp_id(tiny.run_dir / name) for name in NAMES}
    assert {name: after[name] for name in before} == before
    for name in NAMES:
        assert content(tiny.run_dir / name) == content(reference / name), (
            f"{name} differs from an undisturbed run's"
        )
    beside = {path.name for path in tiny.run_dir.iterdir()}
    assert beside <= {*NAMES, *BESIDE}, f"left behind: {beside}"
    count.faults += 1
    count.finished_before += len(before)
    count.used_again += sum(after[name] == identity for name, identity in before.items())


def finished(run_dir: Path) -> dict[str, str]:
    """Stage -> identity of those that are finished and fit what they read; found by other means than the runner's."""
    found: dict[str, str] = {}
    contents: dict[str, str] = {}
    for stage in stages():
        folder = run_dir / stage.name
        if not folder.exists() and (swapped := list(run_dir.glob(f".old-{stage.name}-*"))):
            folder = next(run_dir.glob(f".new-{stage.name}-*/stamp.json"), swapped[0] / "stamp.json").parent
        try:
            stamp = json.loads((folder / "stamp.json").read_text())
        except (OSError, ValueError):
            continue
        forced = run_dir / f".forced-{stage.name}"
        stopped = forced.exists() and forced.read_text(errors="replace") == stamp["id"]
        if stamp["identity"]["reads"] == {name: contents.get(name) for name in stage.reads}:
            contents[stage.name] = stamp["content"]  # made again, it comes out the same
            if not stopped:
                found[stage.name] = stamp["id"]
    return found


def content(folder: Path) -> dict[str, bytes]:
    """All files of a stage but those that name this making of it."""
    files = (path for path in folder.rglob("*") if path.is_file())
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in files
        if path.name not in ("stamp.json", "health.json")
    }


def children_of(pid: int) -> list[int]:
    """Processes that a process has started itself."""
    try:
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []  # it has ended


def ends(pid: int, within_s: float) -> bool:
    """Whether a process ends in this time."""
    deadline = time.monotonic() + within_s
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
            os.kill(pid, 0)
        except OSError:
            return True
        time.sleep(0.01)
    return False
