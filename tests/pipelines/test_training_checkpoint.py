"""A stage's checkpoint: there until the stage is finished, taken up only by the same training."""

import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from devrf.pipelines.budget.training_memory import TrainingMemory, fit_to_memory
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.run_folder.training_checkpoint import training_checkpoint
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import Allowance, Stage, StageContext
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED
from devrf.reconstruct.adapt.footprint import SceneSize, footprint
from devrf.reconstruct.adapt.memory_fit import Limits
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.storage.checkpoint import Checkpoint, Saved
from devrf.reconstruct.storage.training_log import TrainingLog

OPTIONS = CanonicalOptions(resolution=8, iterations=3, rays=16)
SCENE = "{name: small, output: run, capture: {static: static.mp4}, reconstruct: {seed: 1}}"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "static.mp4").write_bytes(b"sweep")
    (tmp_path / "scene.yaml").write_text(SCENE)
    return tmp_path


def run(
    folder: Path,
    stop_after: int = 3,
    options: CanonicalOptions = OPTIONS,
    seed: int = 1,
    most: int | None = None,
    trained: list[CanonicalOptions] | None = None,
) -> list[int]:
    """One run of one stage that trains for three steps, Ctrl-C after some; returns the steps it took.

    Args:
        folder: Of the scene.
        stop_after: Steps.
        options: Asked for.
        seed: A key of the configuration.
        most: Memory that is free, bytes.
        trained: Takes the options that it trains with.
    """
    steps: list[int] = []

    def train(context: StageContext) -> None:
        checkpoint = training_checkpoint(context, "learn", options)
        checkpoint.every_s = 0.0
        memory = TrainingMemory(Limits(most), 0)
        chosen, decisions = fit_to_memory(context, SceneSize(still_pixels=10), options, memory, checkpoint)
        assert bool(decisions) == (chosen != options)
        if trained is not None:
            trained.append(chosen)
        log = TrainingLog("cpu", 1)
        saved = checkpoint.found(log)
        for step in range(0 if saved is None else saved.done, 3):
            if len(steps) == stop_after:
                raise KeyboardInterrupt
            steps.append(step)
            checkpoint.keep(step + 1, 3, log, lambda: ({"grid": torch.zeros(2)}, {}))
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


def test_without_time_it_ends_says_so_and_goes_on(folder: Path, capsys: pytest.CaptureFixture) -> None:
    steps: list[int] = []

    def train(context: StageContext) -> None:
        checkpoint, log = training_checkpoint(context, "learn", OPTIONS), TrainingLog("cpu", 1)
        assert checkpoint.until == context.allowance.until is not None
        saved = checkpoint.found(log)
        for step in range(0 if saved is None else saved.done, 3):
            steps.append(step)
            if steps == [0, 1]:  # time is over in the middle of the first run
                checkpoint.until = 0.0
            checkpoint.keep(step + 1, 3, log, lambda: ({"grid": torch.zeros(2)}, {}))
        (context.out / "model").write_text("learned")

    stage = Stage("learn", (), ("reconstruct.seed",), lambda config: None, train)
    config = load_scene(folder / "scene.yaml", ("budget.time_minutes=60",))
    for code in (FAILED, DONE):
        job = Run(config, folder, (stage,), Choice(), Talk("quiet"))
        assert execute(job) == code and job.standing(stage).error is None
    assert steps == [0, 1, 2]
    said = capsys.readouterr().err
    assert re.search("^learn: .* step 2 of 3 .*budget.time_minutes", said)


def test_with_another_key_or_other_options_it_begins_anew(folder: Path) -> None:
    run(folder, stop_after=2)
    assert run(folder, stop_after=1, seed=2) == [0]
    assert run(folder, seed=2, options=replace(OPTIONS, rays=8)) == [0, 1, 2]


def test_it_goes_on_with_the_options_it_was_begun_with_as_long_as_they_fit(folder: Path) -> None:
    log, goes_on = folder / "run/devrf.log", "goes on from its checkpoint, after step 2"
    asked, trained = replace(OPTIONS, resolution=160), []
    needed = footprint(SceneSize(still_pixels=10), asked).main_bytes
    assert run(folder, 2, asked, most=needed, trained=trained) == [0, 1]
    assert run(folder, 2, asked, most=int(0.4 * needed), trained=trained) == [0, 1]
    assert goes_on not in log.read_text()
    assert asked.resolution == trained[0].resolution > trained[1].resolution
    assert run(folder, 3, asked, most=None, trained=trained) == [2]  # others have ended meanwhile
    assert goes_on in log.read_text()
    assert trained[1] == trained[2]


def here(device: str, said: list[str]) -> StageContext:
    """Of a stage that nobody runs."""
    config, folder = SceneConfig.model_validate({"name": "x", "capture": {"static": "s.mp4"}}), Path()
    return StageContext(config, folder, folder, folder, lambda *_: None, device, say=said.append)


def test_no_bit_of_it_can_change_what_is_trained(tmp_path: Path) -> None:
    """A bit flips on the disk: it goes on as it was begun, or begins anew with what is asked for; it never fails."""
    path, chosen = tmp_path / "state", {"options": {"rays": 8}, "decisions": ["rays: 8"]}

    def fit() -> tuple[CanonicalOptions, list[str], list[str]]:
        said: list[str] = []
        memory = TrainingMemory(Limits(), 0)
        context, size = here("cpu", said), SceneSize(still_pixels=10)
        return *fit_to_memory(context, size, OPTIONS, memory, Checkpoint(path, "one")), said

    Checkpoint(path, "one", chosen=chosen).write(Saved(2, {"grid": torch.zeros(2)}, {}))
    as_begun = (
        replace(OPTIONS, rays=8),
        ["rays: 8"],
        ["  goes on from its checkpoint, after step 2", "  rays: 8"],
    )
    assert fit() == as_begun
    whole = path.read_bytes()
    for at in range(len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 3]) + whole[at + 1 :])
        assert fit() in (as_begun, (OPTIONS, [], [])), at


def test_what_pytorch_keeps_for_itself_on_a_gpu_may_be_trained_with(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("mem_get_info", (20, 80)), ("memory_reserved", 30), ("memory_allocated", 10)):
        monkeypatch.setattr(torch.cuda, name, lambda value=value: value)
    context = here("cuda", [])
    assert TrainingMemory.now(context).limits == Limits(None, 40)
    for budget, left in ((100, 40), (35, 25), (5, 0)):
        context.allowance = Allowance(memory=7, gpu=budget)
        assert TrainingMemory.now(context).limits == Limits(7, left)


def test_one_whose_stage_was_finished_is_cleared_away(folder: Path) -> None:
    """Killed between the stage's last rename and the removal; while a stage is trained anew, its checkpoint stays."""
    run(folder)
    left = folder / "run/.learn.safetensors"
    save_file({"state": torch.zeros(1)}, left, metadata={"devrf": "{}"})
    stamp = (folder / "run/learn/stamp.json").stat().st_mtime
    os.utime(left, (stamp + 10, stamp + 10))
    assert run(folder) == [] and left.exists()
    os.utime(left, (stamp - 10, stamp - 10))
    assert run(folder) == [] and not left.exists()
