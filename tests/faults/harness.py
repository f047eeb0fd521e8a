"""How the tests call the tiny pipeline (tiny_stages.py) as a program."""

import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

PROGRAM = Path(__file__).with_name("tiny_stages.py")
LIMIT_S = 60  # no fault may hang a run


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

    def start(self, *settings: str, new_group: bool = False) -> "subprocess.Popen[str]":
        """Start a run."""
        return subprocess.Popen(
            [sys.executable, str(PROGRAM), str(self.folder), *settings],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=new_group,
        )

    def run(self, *settings: str) -> "subprocess.CompletedProcess[str]":
        """Run to the end, however that comes."""
        started = self.start(*settings)
        try:
            out, err = started.communicate(timeout=LIMIT_S)
        finally:
            started.kill()
        return subprocess.CompletedProcess(started.args, started.returncode, out, err)

    def at_work(self, started: "subprocess.Popen[str]", stage: str) -> None:
        """Wait until a run has begun a stage."""
        deadline = time.monotonic() + LIMIT_S
        while not list(self.run_dir.glob(f".new-{stage}-*")):
            assert started.poll() is None and time.monotonic() < deadline, f"{stage} never began"
            time.sleep(0.005)


def children_of(pid: int) -> list[int]:
    """Processes that a process has started itself."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


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
