"""Damaged files of every kind through the entry points that read them: a message or a result, nothing else.

Every case has a number, which decides file and damage: `--fuzz-case N` in a failure's text repeats it.
"""

import itertools
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from tests.conftest import REPOSITORY
from tests.faults.fuzz_material import Target, targets
from tests.faults.fuzzing import Fuzzer, Outcome, fuzzer

from devrf.capture.scene import Scene

SMALL, FULL = 60, 500


@pytest.fixture(scope="module")
def run() -> Iterator[Fuzzer]:
    with fuzzer() as one:
        yield one


def attempt(run: Fuzzer, target: Target, damaged: bytes) -> tuple[Outcome, str | None]:
    """How the target's way in takes a damaged file, and what is wrong with that."""
    whole = target.file.read_bytes()
    target.file.write_bytes(damaged)
    try:
        if target.scene is None:
            outcome = run.read(target.reader, target.file)
        else:
            outcome = run.command("run", target.scene, *target.arguments)
        fault = outcome.fault(target.allowed)
        if (
            fault is None
            and outcome.code in (1, 2)
            and not any(word in outcome.said for word in target.named)
        ):
            fault = "does not name the file"
        if fault is None and target.scene is not None:
            fault = half_made(target.scene / "run", outcome)
        return outcome, fault
    finally:
        target.file.write_bytes(whole)
        if target.scene is not None:
            shutil.rmtree(target.scene / "run", ignore_errors=True)


def half_made(run_dir: Path, outcome: Outcome) -> str | None:
    """A stage's folder without its stamp, or leftovers of one."""
    for folder in run_dir.glob("*"):
        if folder.is_dir() and not folder.name.startswith(".") and not (folder / "stamp.json").is_file():
            return f"left {folder.name} without a stamp"
        if folder.name.startswith((".new-", ".old-")):
            return f"left {folder.name}"
    return None


def damage(whole: bytes, target: Target, case: int) -> bytes:
    rng = np.random.default_rng(case)
    for _ in itertools.count():
        mutation = target.mutations[int(rng.integers(len(target.mutations)))]
        damaged = mutation(whole, rng)
        if damaged != whole:
            return damaged
    raise AssertionError


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damage")


def test_files(run: Fuzzer, places: Path, odd_scene: Scene, data_dir: Path) -> None:
    found = targets(places, odd_scene, REPOSITORY, data_dir)
    for case, name in zip(range(SMALL), itertools.cycle(found), strict=False):
        target = found[name]
        outcome, fault = attempt(run, target, damage(target.file.read_bytes(), target, case))
        assert fault is None, f"case {case}, {name}: {fault}\n--- it said\n{outcome.said[-3000:]}"
