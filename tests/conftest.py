"""Fixtures that many tests share."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest
from hypothesis import settings
from tests.type_checks import check_once

if TYPE_CHECKING:
    from devrf.capture.scene import Scene, Split

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before a test imports torch; devrf does the same
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the workers have the cores already
# those of a shell's job in the background and of nohup are ignored, by all that they start
for _signal, _usual in ((signal.SIGINT, signal.default_int_handler), (signal.SIGHUP, signal.SIG_DFL)):
    if signal.getsignal(_signal) is signal.SIG_IGN:
        signal.signal(_signal, _usual)

check_once()  # before a test imports devrf

settings.register_profile("same every time", derandomize=True, database=None, deadline=None)
settings.load_profile("same every time")

REPOSITORY = Path(__file__).resolve().parent.parent
EXAMPLE = REPOSITORY / "examples" / "workshop"
RUN_LIMIT_S = 1500  # a hung library must not hang the tests
# of `whole_run`; they take minutes, so one worker makes each for all tests
RUNS = ("example_run", "small_run")
SMALL_FILM = (12, 12.0, 8_000)  # for `stages.render.SIZES`: a film of a second
WITH_SMALL_FILM = f"""
from devrf.pipelines.cli.main import main
from devrf.pipelines.stages import render
render.SIZES["tiny"] = {SMALL_FILM}
main()
"""
# folders and files, longest first, so that no worker ends long after the others
FIRST = ("end_to_end", "test_crew_files.py", "browser", "faults", "lab", "pipelines")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Sizes of the fault suite (tests/faults); here, so that they are known wherever pytest is called."""
    group = parser.getgroup("faults", "fault suite")
    group.addoption(
        "--faults",
        choices=("small", "full"),
        default="small",
        help="how many faults: small fits CI; full is what docs/reliability.md reports",
    )
    group.addoption(
        "--figures", type=Path, metavar="FILE", help="append what the tests measured, as JSON lines"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Longest first."""

    def rank(item: pytest.Item) -> int:
        place = item.path.relative_to(REPOSITORY / "tests").parts[0]
        return FIRST.index(place) if place in FIRST else len(FIRST)

    items.sort(key=rank)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each worker whole files, and all tests of one long run to one worker."""
    from xdist.scheduler import LoadScopeScheduling

    class Files(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return next((name for name in RUNS if name in nodeid), nodeid.split("::")[0])

    return Files(config, log)


@pytest.fixture(scope="session")
def faults(request: pytest.FixtureRequest) -> Literal["small", "full"]:
    """How many faults the fault suite makes."""
    return "full" if request.config.getoption("--faults") == "full" else "small"


Figures = Callable[..., None]


@pytest.fixture
def figures(request: pytest.FixtureRequest) -> Figures:
    """Append what a test measured to the file of `--figures`: `figures(kills=200, lost=0)`."""
    file: Path | None = request.config.getoption("--figures")

    def note(**values: Any) -> None:
        line = json.dumps({"test": request.node.name, **values})
        print(line)
        if file is not None:
            with file.open("a", encoding="utf-8") as lines:
                lines.write(f"{line}\n")

    return note


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real captures: `DEVRF_DATA`, or ../shared/data beside the repository.

    Tests that need it skip where it is absent, but fail under CI, so that a missing mount is noticed.
    """
    return _shared("DEVRF_DATA", "data")


@pytest.fixture(scope="session")
def crew_files() -> Path:
    """The folder of captures as crews bring them: `DEVRF_CASES`, or ../shared/cases/capture beside the repository.

    As with `data_dir`, tests skip where it is absent and fail under CI.
    """
    return _shared("DEVRF_CASES", "cases/capture")


def _shared(variable: str, place: str) -> Path:
    folder = Path(os.environ.get(variable, REPOSITORY.parent / "shared" / place))
    if not folder.is_dir():
        missing = pytest.fail if os.environ.get("CI") == "true" else pytest.skip
        missing(f"captures not found at {folder}; set {variable}")
    return folder


@pytest.fixture
def odd_scene(tmp_path: Path) -> "Scene":
    """A small scene with everything that formats forget: lens distortion, a principal point off the middle,
    pictures that are not square, cameras of different sizes, clocks that are not triggered together."""
    import cv2
    import numpy as np
    from tests.make.scenes import scene_of

    from devrf.capture.camera import Camera
    from devrf.capture.scene import PosedFrame, SparsePoints
    from devrf.capture.view_axes import look_at

    rng = np.random.default_rng(5)
    lenses = {
        "static": (96, 64, [80.0, 81, 50.5, 30.25], [-0.12, 0.03, 0.001, -0.002, 0.0]),
        "cam0": (88, 60, [75.0, 74, 42.0, 31.5], [-0.08, 0.01, 0.0, 0.001, 0.0]),
        "cam1": (80, 56, [70.0, 70, 41.0, 27.0], [0.05, 0.0, 0.0, 0.0, 0.002]),
        "witness": (88, 60, [76.0, 76, 44.0, 30.0], [0.0, 0.0, 0.0, 0.0, 0.0]),
    }

    def frame(name: str, n: int, angle: float, time: float | None, split: "Split") -> PosedFrame:
        width, height, (fx, fy, cx, cy), lens = lenses[name]
        centre = 4.0 * np.array([np.sin(angle), 0.1 * np.cos(7 * angle), -np.cos(angle)])
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        path = tmp_path / "pictures" / f"{name}_{n}.png"
        path.parent.mkdir(exist_ok=True)
        picture = cv2.resize(rng.integers(0, 255, (6, 9, 3)).astype(np.uint8), (width, height))
        cv2.imwrite(str(path), picture)
        camera = Camera(width, height, K, look_at(centre, np.zeros(3), (-0.05, -1.0, 0.0)), np.array(lens))
        time_s = None if time is None else 2.0 + 3.0 * time
        return PosedFrame(path, camera, name, n, time_s, time, split)

    static = [frame("static", n, -0.5 + 0.2 * n, None, "test" if n in (1, 4) else "train") for n in range(6)]
    dynamic = [
        frame(name, n, angle, min(1.0, n / 4 + late), "test" if name == "witness" else "train")
        for name, angle, late in (("cam0", -0.4, 0.0), ("cam1", 0.4, 0.0621), ("witness", 0.05, 0.0313))
        for n in range(5)
    ]
    xyz = rng.uniform(-0.5, 0.5, (40, 3))
    observed = [(p, f) for p in range(40) for f in range(6)]
    points = SparsePoints(xyz, np.array([p for p, _ in observed]), np.array([f for _, f in observed]))
    box = {"aabb": np.array([[-1.0, -0.8, -0.9], [1.0, 0.8, 0.9]]), "near": 2.0, "far": 7.5}
    return scene_of(static, dynamic, 1.25, **box, t0_s=2.0, t1_s=5.0, metric=True, points=points)


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
    """Call the command line in this process, as below its supervisor: `devrf("run", scene, "--until", "ingest")`.

    Stages read nothing that they do not declare (tests/declared.py).
    """
    from tests.declared import watch
    from typer.testing import CliRunner

    from devrf.pipelines.cli.main import app

    watched = watch()

    def call(*arguments: str | Path) -> CommandResult:
        start = time.monotonic()
        result = CliRunner().invoke(app, [str(argument) for argument in arguments])
        seconds, err = time.monotonic() - start, result.stderr
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            err += "".join(traceback.format_exception(result.exception))
        assert watched.undeclared() == []
        return CommandResult(result.exit_code, result.stdout, err, seconds)

    return call


@pytest.fixture(scope="session")
def devrf_process() -> Command:
    """The same in a process of its own, where a test is about processes: signals, memory, what libraries print."""

    def call(*arguments: str | Path, limit_s: float = RUN_LIMIT_S) -> CommandResult:
        start = time.monotonic()
        result = subprocess.run(
            [sys.executable, "-m", "devrf.pipelines.cli.main", *map(str, arguments)],
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
def example_run(tmp_path_factory: pytest.TempPathFactory) -> ExampleRun:
    """The pipeline, run once on a copy of the example session, in a process of its own: its memory is measured.

    `DEVRF_EXAMPLE_RUN` names a folder that is kept and used again, to work on such tests.
    """
    kept = os.environ.get("DEVRF_EXAMPLE_RUN")
    folder = Path(kept).resolve() if kept else tmp_path_factory.mktemp("example") / "session"
    if not folder.exists():
        shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("runs"))
    command = [sys.executable, "-c", WITH_SMALL_FILM, "run", str(folder), "--preset", "tiny"]
    done = subprocess.run(
        [*command, "--set", "output=run"], capture_output=True, text=True, timeout=RUN_LIMIT_S
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return ExampleRun(folder / "scene.yaml", folder / "run")


@pytest.fixture(scope="session")
def small_run(devrf: Command, tmp_path_factory: pytest.TempPathFactory) -> ExampleRun:
    """The pipeline, run once in this process on a session that takes seconds."""
    from tests.end_to_end.small_session import write_small_session

    from devrf.pipelines.stages import render

    scene = write_small_session(tmp_path_factory.mktemp("small"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(render.SIZES, "tiny", SMALL_FILM)
        result = devrf("run", scene, "--device", "cpu")
    assert result.code == 0, result.said
    return ExampleRun(scene, scene.parent / "run")


@pytest.fixture(scope="session", params=["small_run", pytest.param("example_run", marks=pytest.mark.full)])
def whole_run(request: pytest.FixtureRequest) -> ExampleRun:
    """Every stage of a session, in small and of the whole example. Its name in a test's name binds it to a worker."""
    return request.getfixturevalue(request.param)
