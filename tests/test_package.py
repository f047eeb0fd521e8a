"""pyproject.toml, constraints.txt and the Makefile agree with one another."""

import ast
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

import devrf

REPOSITORY = Path(__file__).resolve().parent.parent
PYTHONS = ("3.10", "3.11", "3.12", "3.13")


def requirements() -> list[Requirement]:
    """Every dependency of pyproject.toml, those of the extras too."""
    text = (REPOSITORY / "pyproject.toml").read_text()
    project = text[text.index("[project]") : text.index("[project.scripts]")]
    found = [
        Requirement(line) for line in re.findall(r'"([^"]+)"', project) if re.match(r"[\w\[\]-]+>=", line)
    ]
    assert len(found) > 20
    return [r for r in found if r.name != "python"]


def pins(python: str) -> dict[str, Version]:
    """Name -> version that constraints.txt gives to a Python."""
    found = {}
    for line in (REPOSITORY / "constraints.txt").read_text().splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            if pin.marker is None or pin.marker.evaluate({"python_version": python}):
                assert pin.name.lower() not in found, f"{pin.name} is pinned twice for Python {python}"
                (rule,) = pin.specifier
                assert rule.operator == "=="
                assert not pin.extras, "pip refuses extras in constraints"
                found[pin.name.lower()] = Version(rule.version)
    return found


@pytest.mark.parametrize("python", PYTHONS)
def test_every_direct_dependency_is_pinned_within_its_range(python: str) -> None:
    pinned = pins(python)
    wanted = [r for r in requirements() if r.marker is None or r.marker.evaluate({"python_version": python})]
    assert {requirement.name.lower() for requirement in wanted} == set(pinned)
    for requirement in wanted:
        assert requirement.specifier.contains(pinned[requirement.name.lower()]), requirement


def test_version_is_said_once() -> None:
    text = (REPOSITORY / "pyproject.toml").read_text()
    assert f'version = "{devrf.__version__}"' in text
    assert importlib.metadata.version("devrf") == devrf.__version__


def test_public_names_are_there_and_hide_no_room() -> None:
    tree = ast.parse(Path(devrf.__file__).read_text())
    (seen,) = (node for node in tree.body if isinstance(node, ast.If))  # by editors and type checkers
    imports = [alias.asname or alias.name for node in seen.body for alias in getattr(node, "names", ())]
    assert sorted(imports) == sorted(devrf.__all__) and set(devrf.__all__) <= set(dir(devrf))
    for name in devrf.__all__:
        assert getattr(devrf, name).__doc__
        assert not (REPOSITORY / name).exists(), f"devrf.{name} is a room"
    with pytest.raises(AttributeError, match="reconstruction"):
        _ = devrf.reconstruction  # type: ignore[attr-defined]


def test_module_and_console_script_are_the_same_program() -> None:
    result = subprocess.run([sys.executable, "-m", "devrf", "--version"], capture_output=True, text=True)
    assert result.stdout.strip() == f"devrf {devrf.__version__}"


def test_docstring_examples_hold() -> None:
    """pytest's own doctest option would import the folders by their bare names."""
    import doctest
    import importlib

    for room in ("capture", "calibration", "flow", "reconstruct", "pipelines", "lab"):
        for path in (REPOSITORY / room).rglob("*.py"):
            if ">>> " in path.read_text():
                name = ".".join(("devrf", *path.relative_to(REPOSITORY).with_suffix("").parts))
                assert doctest.testmod(importlib.import_module(name)).failed == 0, name
