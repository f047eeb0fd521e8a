"""Damaged files of every kind through the entry points that read them: a message or a result, nothing else.

A case's number decides file and damage, so that a failure can be repeated: `damage(whole, target, case)`.
"""

import itertools
import shutil
from collections import Counter
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from tests.conftest import REPOSITORY, Figures
from tests.faults.fuzz_material import Target, targets
from tests.faults.fuzzing import Fuzzer, Outcome

from devrf.capture.scene import Scene
from devrf.pipelines.stages import stage_names

pytestmark = pytest.mark.full

CASES = 500  # of the full suite; the small one takes a case of each kind of file


def attempt(run: Fuzzer, target: Target, damaged: bytes) -> tuple[Outcome, str | None]:
    """How the target's way in takes a damaged file, and what is wrong with that."""
    whole, place = target.file.read_bytes(), target.file
    if target.template is not None and target.scene is not None:
        shutil.copytree(target.template, target.scene / "run", symlinks=True)
        place = target.scene / "run" / target.file.relative_to(target.template)
    place.write_bytes(damaged)
    try:
        if target.scene is None:
            outcome = run.read(target.reader, place)
        else:
            outcome = run.command(target.command, target.scene, *target.arguments)
        fault = outcome.fault(target.allowed)
        if (
            fault is None
            and outcome.code in (1, 2)
            and not any(word in outcome.said for word in target.named)
        ):
            fault = "does not name the file"
        if fault is None and target.scene is not None and target.command == "run":
            fault = half_made(target.scene / "run", outcome)
        return outcome, fault
    finally:
        place.write_bytes(whole)
        if target.scene is not None:
            shutil.rmtree(target.scene / "run", ignore_errors=True)


def half_made(run_dir: Path, outcome: Outcome) -> str | None:
    """A stage's folder without its stamp, or leftovers of one."""
    for name in stage_names():
        if (run_dir / name).is_dir() and not (run_dir / name / "stamp.json").is_file():
            return f"left {name} without a stamp"
    left = [path.name for path in run_dir.glob(".*") if path.name.startswith((".new-", ".old-"))]
    return f"left {left[0]}" if left else None


def damage(whole: bytes, target: Target, case: int) -> bytes:
    """The file of a case."""
    rng = np.random.default_rng(case)
    damaged = whole
    while damaged == whole:
        damaged = target.mutations[int(rng.integers(len(target.mutations)))](whole, rng)
    return damaged


def test_files(
    run: Fuzzer,
    tmp_path: Path,
    odd_scene: Scene,
    data_dir: Path,
    faults: Literal["small", "full"],
    figures: Figures,
) -> None:
    found = targets(tmp_path / "files", odd_scene, REPOSITORY, data_dir)
    for name, target in found.items():
        outcome, fault = attempt(run, target, target.file.read_bytes())
        assert fault is None and outcome.code in (0, 3), f"{name}, whole: {fault}\n{outcome.said[-3000:]}"
    cases = CASES if faults == "full" else len(found)
    codes: Counter[int | None] = Counter()
    failures = []
    for case, name in zip(range(cases), itertools.cycle(found), strict=False):
        target = found[name]
        outcome, fault = attempt(run, target, damage(target.file.read_bytes(), target, case))
        codes[outcome.code] += 1
        if fault is not None:
            failures.append(f"case {case}, {name}: {fault}\n--- it said\n{outcome.said[-3000:]}")
    codes_said = {str(code): count for code, count in codes.items()}
    figures(fuzzed_files=cases, kinds=len(found), faults=len(failures), exit_codes=codes_said,
            slowest_s=round(run.slowest_s, 1), most_worked_s=round(run.most_worked_s, 1),
            most_mb=round(run.most_mb))  # fmt: skip
    assert not failures, "\n\n".join(failures)
