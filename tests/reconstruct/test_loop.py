"""Under every training: take up, step, guard, keep, tell."""

from pathlib import Path

import pytest
import torch
from tests.reconstruct.deaths import until_done
from tests.refused import refused

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.guard import MOST
from devrf.reconstruct.training.loop import ON_CPU, Step, Training, TrainingRun, train


class Falling(Training):
    """A number that falls with each step, or leaps where steps are too large."""

    name = "falling"

    def __init__(self, iterations: int = 20, leaps_above: float = 2.0) -> None:
        super().__init__(iterations, torch.Generator())
        self.value, self.leaps_above = 1.0, leaps_above
        self.steps: list[int] = []

    def step(self, iteration: int) -> Step:
        self.steps.append(iteration)
        self.value *= 100.0 if self.guard.rate > self.leaps_above else 0.9
        return Step(3, {"mse": torch.tensor(self.value)})

    def state(self) -> State:
        return {"value": torch.tensor(self.value, dtype=torch.float64)}, {}

    def take_up(self, saved: Saved) -> None:
        self.value = float(saved.tensors["value"])

    def go_back(self) -> int:
        self.value = 1.0
        return 0

    def shown(self) -> float:
        return self.value


def test_all_steps_are_done_and_told() -> None:
    told, seen, log = [], [], TrainingLog("cpu", 5)
    run = TrainingRun(
        progress=lambda share, text: told.append((share, text)),
        watch=Watch(0.0, lambda value, s: seen.append(value)),
    )
    training = Falling()
    train(training, log, run, lambda: told.append("begun"))
    assert training.steps == list(range(20)) and (log.iteration, log.rays) == (20, 60)
    assert told[0] == "begun" and told[1] == (0.0, "falling, iteration 0 of 20")
    assert told[2][0] == 0.5 and "PSNR" in told[2][1] and len(told) == 3
    assert seen == [pytest.approx(0.9), pytest.approx(0.9**11)]


def test_one_that_dies_is_taken_up_where_it_was(tmp_path: Path) -> None:
    undisturbed, found = Falling(), []
    train(undisturbed, TrainingLog("cpu", 5), ON_CPU)

    def again(state) -> Falling:
        training = Falling()
        found.append(training)
        train(training, TrainingLog("cpu", 5), TrainingRun(checkpoint=state))
        return training

    assert until_done(again, tmp_path, {("", 4), ("", 11)}).value == undisturbed.value
    assert [training.steps[0] for training in found] == [0, 4, 11]


def test_one_that_runs_away_goes_back_with_smaller_steps() -> None:
    training = Falling(leaps_above=0.5)
    train(training, TrainingLog("cpu", 1000), ON_CPU)
    assert training.guard.restarts == 1 and training.value == pytest.approx(0.9**20)


def test_one_that_always_runs_away_is_an_error() -> None:
    training = Falling(leaps_above=0.0)
    with refused("training-diverged", "falling, iteration", kind=ReconstructError):
        train(training, TrainingLog("cpu", 1000), ON_CPU)
    assert training.guard.restarts == MOST
