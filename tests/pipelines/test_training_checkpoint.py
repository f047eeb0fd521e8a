"""A stage's checkpoint: there until the stage is finished, taken up only by the same training."""

import os
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.exit_codes import DONE, STOPPED
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.training_checkpoint import training_checkpoint
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.training_log import TrainingLog

OPTIONS = CanonicalOptions(resolution=8, iterations=3, rays=16)
SCENE = "{name: small, output: run, capture: {static: static.mp4}, reconstruct: {seed: 1}}"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "static.mp4").write_bytes(b"sweep")
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


def run(folder: Path, stop_after: int = 3, options: CanonicalOptions = OPTIONS, seed: int = 1) -> list[int]:
    """One run of one stage that trains for three steps, Ctrl-C after some; returns the steps it took."""
    steps: list[int] = []

    def train(context: StageContext) -> None:
        checkpoint = training_checkpoint(context, "learn", options)
        checkpoint.every_s = 0.0
        log = TrainingLog("cpu", 1)
        saved = checkpoint.found(log)
        for step in range(0 if saved is None else saved.done, 3):
            if len(steps) == stop_after:
                raise KeyboardInterrupt
            steps.append(step)
            checkpoint.keep(step + 1, log, lambda: ({"grid": torch.zeros(2)}, {}))
        (context.out / "model").write_text("learned")

    stage = Stage("learn", (), ("reconstruct.seed",), lambda config: None, train)
    config = load_scene(folder / "scene.yaml", (f"reconstruct.seed={seed}",))
    code = execute(Run(config, folder, (stage,), Choice(), Talk("quiet")))
    assert code == (DONE if (folder / "run/learn/model").exists() else STOPPED)
    return steps


def test_it_goes_on_and_is_removed_once_the_stage_is_finished(folder: Path) -> None:
    assert run(folder, stop_after=2) == [0, 1]
    assert (folder / "run/.learn.safetensors").exists()
    assert run(folder) == [2]
    assert not list((folder / "run").glob(".learn*"))


def test_with_another_key_or_other_options_it_begins_anew(folder: Path) -> None:
    run(folder, stop_after=2)
    assert run(folder, stop_after=1, seed=2) == [0]
    assert run(folder, seed=2, options=replace(OPTIONS, rays=8)) == [0, 1, 2]


def test_one_whose_stage_was_finished_is_cleared_away(folder: Path) -> None:
    """Killed between the stage's last rename and the removal; while a stage is trained anew, its checkpoint stays."""
    run(folder)
    left = folder / "run/.learn.safetensors"
    left.write_bytes(b"state")
    stamp = (folder / "run/learn/stamp.json").stat().st_mtime
    os.utime(left, (stamp + 10, stamp + 10))
    assert run(folder) == [] and left.exists()
    os.utime(left, (stamp - 10, stamp - 10))
    assert run(folder) == [] and not left.exists()
