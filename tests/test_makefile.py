"""The two commands of the README, as far as they can be checked without a network."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")


def make(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MAKE")}
    return subprocess.run(["make", *arguments], cwd=folder, capture_output=True, text=True, env=environment)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    for name in ("Makefile", "pyproject.toml", "setup.py", "constraints.txt"):
        shutil.copy(REPOSITORY / name, tmp_path)
    return tmp_path


def fake_python(folder: Path, text: str) -> Path:
    path = folder / "fake-python"
    path.write_text(text)
    path.chmod(0o755)
    return path


def test_an_old_python_is_refused_with_a_remedy(copy: Path) -> None:
    old = fake_python(copy, '#!/bin/sh\n[ "$1" = --version ] && echo Python 3.8.1 && exit 0\nexit 1\n')
    result = make(copy, "venv", f"PYTHON={old}")
    assert result.returncode != 0
    assert "Python 3.8.1" in result.stdout and "Python 3.10" in result.stdout
    assert not (copy / ".venv").exists()


def test_the_example_that_demo_runs_exists() -> None:
    result = make(REPOSITORY, "-n", "demo")
    assert result.returncode == 0, result.stderr
    (line,) = [line for line in result.stdout.splitlines() if "devrf-pipeline run" in line]
    scene = line.split("devrf-pipeline run ")[1].split()[0]
    assert (REPOSITORY / scene).is_file()


def test_docs_are_built_strictly_with_their_extra() -> None:
    result = make(REPOSITORY, "-n", "docs", "VENV=none")
    assert result.returncode == 0, result.stderr
    assert "-e '.[docs]'" in result.stdout and "none/bin/mkdocs build --strict" in result.stdout


def test_nothing_is_installed_twice(copy: Path) -> None:
    """pip is called the first time, not the second, and again when the constraints change."""
    log = copy / "pip.log"
    work = (
        "#!/bin/sh\n"
        f'if [ "$1" = -m ] && [ "$2" = venv ]; then mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; exit 0; fi\n'
        f'if [ "$1" = -m ] && [ "$2" = pip ]; then echo "$@" >> {log}; exit 0; fi\n'
        f'exec {sys.executable} "$@"\n'
    )
    python = fake_python(copy, work)
    dev = ".venv/.installed-dev"  # which brings all that `venv` does
    for target, expected in (("venv", 1), ("venv", 1), (dev, 2), (dev, 2), ("venv", 2)):
        assert make(copy, target, f"PYTHON={python}").returncode == 0
        assert len(log.read_text().splitlines()) == expected
    stamp = (copy / ".venv/.installed").stat().st_mtime
    os.utime(copy / "constraints.txt", (stamp + 10, stamp + 10))
    assert make(copy, "venv", f"PYTHON={python}").returncode == 0
    assert len(log.read_text().splitlines()) == 3
    assert "-c constraints.txt -e ." in log.read_text()


def test_continuous_integration_runs_every_test() -> None:
    script = REPOSITORY / ".ci" / "run"
    assert os.access(script, os.X_OK)
    assert "set -euo pipefail" in script.read_text() and "make test-full" in script.read_text()
    quick, full = (
        [
            line
            for line in make(REPOSITORY, "-n", name, "VENV=none").stdout.splitlines()
            if "none/bin/" in line
        ]
        for name in ("test", "test-full")
    )
    assert quick == [*full[:-1], f'{full[-1]} -m "not full"']
    for program in ("ruff format --check", "ruff check", "pyright", "pytest -n 2"):
        assert sum(program in line for line in full) == 1
