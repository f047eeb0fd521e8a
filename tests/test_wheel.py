"""What is installed: every source and data file of the six folders, the example, and nothing else."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab")


EXAMPLE = "examples/workshop"
MOST_BYTES = 15_000_000


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of what is needed to build it."""
    tree = tmp_path_factory.mktemp("tree")
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info", "runs")
    for folder in ("src", EXAMPLE, *ROOMS):
        shutil.copytree(REPOSITORY / folder, tree / folder, ignore=ignore)
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(REPOSITORY / name, tree)
    result = subprocess.run(
        [sys.executable, "setup.py", "-q", "bdist_wheel", "-d", "dist"],
        cwd=tree,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    (wheel,) = (tree / "dist").glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel_names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def expected() -> set[str]:
    names = set()
    for room in ROOMS:
        for path in (REPOSITORY / room).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                names.add(f"devrf/{path.relative_to(REPOSITORY).as_posix()}")
    names |= {f"devrf/example/{path.name}" for path in (REPOSITORY / EXAMPLE).iterdir() if path.is_file()}
    top = REPOSITORY / "src"
    own = (path.relative_to(top).as_posix() for path in (top / "devrf").rglob("*") if path.is_file())
    return names | {name for name in own if "__pycache__" not in name}


def test_the_wheel_holds_exactly_what_the_tree_holds(wheel_names: set[str]) -> None:
    assert wheel_names == expected()


def test_no_generic_name_is_installed(wheel_names: set[str]) -> None:
    assert {name.split("/")[0] for name in wheel_names} == {"devrf"}


def test_size_licences_and_the_way_in(wheel: Path) -> None:
    assert wheel.stat().st_size < MOST_BYTES
    with zipfile.ZipFile(wheel) as archive:
        texts = {Path(name).name: archive.read(name) for name in archive.namelist() if ".dist-info/" in name}
    points = [line for line in texts["entry_points.txt"].decode().splitlines() if line]
    assert points == [
        "[console_scripts]",
        "devrf-pipeline = devrf.__main__:main",
        "[devrf.commands]",
        "bench = devrf.lab.bench.bench_command:bench",
        "simulate = devrf.lab.lab_commands:simulate",
    ]
    assert texts["LICENSE"] == (REPOSITORY / "LICENSE").read_bytes() and b"Version 2.0" in texts["LICENSE"]
    assert texts["NOTICE"] == (REPOSITORY / "NOTICE").read_bytes()
    assert b"License-Expression: Apache-2.0" in texts["METADATA"]


@pytest.mark.full
def test_installed_elsewhere_it_runs_its_example(wheel: Path, tmp_path: Path) -> None:
    """Without the tree: the wheel unpacked, and the libraries that are here, but for what leads to the tree."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "installed")
    libraries = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    paths = os.pathsep.join([str(tmp_path / "installed"), *libraries])
    isolated = {**os.environ, "PYTHONPATH": paths}

    def called(*arguments: str, module: tuple[str, ...] = ("-m", "devrf")) -> str:
        # -S: no editable installation of this tree
        command = [sys.executable, "-S", *module, *arguments]
        ended = subprocess.run(command, cwd=tmp_path, env=isolated, capture_output=True, text=True)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    assert called("--version").startswith("devrf ")
    assert "ablation" in called("bench", "--help") and "--protocol" in called("simulate", "--help")
    called("demo", "here", "--until", "ingest", "--quiet")
    stamp = tmp_path / "here" / "runs" / "workshop" / "ingest" / "stamp.json"
    assert stamp.is_file() and str(REPOSITORY) not in stamp.read_text()
    called("demo", "here", "--until", "ingest", "--quiet")
    clips = "import devrf; print(*devrf.ingest('here', quiet=True), devrf.__file__)"
    names = called("-c", clips, module=()).split()
    assert {"static", "cam0", "witness"} <= set(names) and names[-1].startswith(str(tmp_path))


def test_notice_names_every_dependency() -> None:
    project = (REPOSITORY / "pyproject.toml").read_text().split("[project]")[1].split("[project.scripts]")[0]
    named = set(re.findall(r"^  (\S+) {2,}\S", (REPOSITORY / "NOTICE").read_text(), re.MULTILINE))
    needed = {name.lower() for name in re.findall(r'"([\w.-]+)(?:\[\w+\])?>=[\d.]', project)}
    assert named == needed


def test_citation_and_package_agree() -> None:
    version = re.search(r'^version = "(.+)"$', (REPOSITORY / "pyproject.toml").read_text(), re.MULTILINE)
    assert version is not None
    assert f"\nversion: {version[1]}\n" in (REPOSITORY / "CITATION.cff").read_text()
