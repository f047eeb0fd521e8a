"""Fixtures that many tests share."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
EXAMPLE = REPOSITORY / "examples" / "waving-sheet"
RUN_LIMIT_S = 1500  # a hung library must not hang the tests


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real captures: `DEVRF_DATA`, or ../shared/data beside the repository.

    Tests that need it skip where it is absent, but fail under CI, so that a missing mount is noticed.
    """
    folder = Path(os.environ.get("DEVRF_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        if os.environ.get("CI") == "true":
            pytest.fail(f"real captures not found at {folder}; set DEVRF_DATA")
        pytest.skip(f"real captures not found at {folder}; set DEVRF_DATA")
    return folder


@dataclass(frozen=True)
class CommandResult:
    """What a command left: exit code, what it printed, how long it took."""

    code: int
    out: str
    err: str
    seconds: float

    @property
    def said(self) -> str:
        """Both streams."""
        return self.out + self.err


Command = Callable[..., CommandResult]


@pytest.fixture(scope="session")
def devrf() -> Command:
    """Call the real command line in a process of its own: `devrf("run", scene, "--until", "ingest")`."""

    def call(*arguments: str | Path, limit_s: float = RUN_LIMIT_S) -> CommandResult:
        start = time.monotonic()
        result = subprocess.run(
            [sys.executable, "-m", "devrf.pipelines.cli", *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=limit_s,
        )
        seconds = time.monotonic() - start
        return CommandResult(result.returncode, result.stdout, result.stderr, seconds)

    return call


@dataclass(frozen=True)
class ExampleRun:
    """The example session, run once."""

    scene: Path
    run_dir: Path


@pytest.fixture(scope="session")
def example_run(devrf: Command, tmp_path_factory: pytest.TempPathFactory) -> ExampleRun:
    """The pipeline, run once on a copy of the example session; many tests look at what it left.

    `DEVRF_EXAMPLE_RUN` names a folder that is kept and used again, to work on such tests.
    """
    kept = os.environ.get("DEVRF_EXAMPLE_RUN")
    folder = Path(kept).resolve() if kept else tmp_path_factory.mktemp("example") / "session"
    if not folder.exists():
        shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("runs"))
    run_dir = folder / "run"
    result = devrf("run", folder, "--preset", "tiny", "--set", "output=run")
    assert result.code == 0, result.said
    return ExampleRun(folder / "scene.yaml", run_dir)
