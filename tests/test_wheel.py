"""What is installed: every source and data file of the five folders, and nothing else."""

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
ROOMS = ("capture", "calibration", "flow", "reconstruct", "pipelines")


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names in a wheel built from a copy of what is needed to build it."""
    tree = tmp_path_factory.mktemp("tree")
    ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for folder in ("src", *ROOMS):
        shutil.copytree(REPOSITORY / folder, tree / folder, ignore=ignore)
    for name in ("pyproject.toml", "setup.py", "README.md"):
        if (REPOSITORY / name).exists():
            shutil.copy(REPOSITORY / name, tree)
    result = subprocess.run(
        [sys.executable, "setup.py", "-q", "bdist_wheel", "-d", "dist"],
        cwd=tree,
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    (wheel,) = (tree / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if ".dist-info/" not in name}


def expected() -> set[str]:
    names = set()
    for room in ROOMS:
        for path in (REPOSITORY / room).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                names.add(f"devrf/{path.relative_to(REPOSITORY).as_posix()}")
    return names | {"devrf/__init__.py", "devrf/py.typed"}


def test_the_wheel_holds_exactly_what_the_tree_holds(wheel_names: set[str]) -> None:
    assert wheel_names == expected()


def test_no_generic_name_is_installed(wheel_names: set[str]) -> None:
    assert {name.split("/")[0] for name in wheel_names} == {"devrf"}
