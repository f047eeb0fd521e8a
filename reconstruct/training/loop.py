"""The one loop under every training: take up, step, guard, keep, tell."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from devrf.capture.system.progress import Progress, no_progress, part
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint, Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.guard import Guard, diverged


@dataclass(frozen=True)
class TrainingRun:
    """Where a training runs, who is told how far it is, and where its state is kept.

    Attributes:
        device: cpu or cuda.
        progress: Told how far it is.
        checkpoint: Where to keep the state between two steps, and to take it up from.
        watch: Shown what is trained now and then.
    """

    device: str = "cpu"
    progress: Progress = no_progress
    checkpoint: Checkpoint = NOWHERE
    watch: Watch | None = None

    def part(self, name: str, start: float = 0.0, share: float = 1.0) -> "TrainingRun":
        """Of a phase that begins at a share of the progress; with a name of its own it is kept apart, unwatched."""
        told = replace(self, progress=part(self.progress, start, share))
        return replace(told, checkpoint=self.checkpoint.part(name), watch=None) if name else told


ON_CPU = TrainingRun()


class Step(NamedTuple):
    """What a step was: rays drawn, unweighted losses, and what the log's row is labelled with."""

    rays: int
    losses: dict[str, Tensor]
    labels: Mapping[str, float] = {}


class Training(ABC):
    """What is trained, and how.

    Attributes:
        name: As messages call it.
        iterations: Steps in all.
        generator: Of every random draw.
        guard: Watches the losses of steps that tell them.
        keep_every, tell_every: Steps between two points at which the state may be kept; at which it is told how far
            the training is.
    """

    name = ""
    keep_every = 1
    tell_every = 10

    def __init__(self, iterations: int, generator: torch.Generator) -> None:
        self.iterations, self.generator, self.guard = iterations, generator, Guard()

    @abstractmethod
    def step(self, iteration: int) -> Step | None:
        """One iteration; None where nothing is watched by the loop."""

    @abstractmethod
    def state(self) -> State:
        """Everything that the next iteration depends on, beside generator and guard."""

    @abstractmethod
    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""

    def go_back(self) -> int:
        """To the last good point, fresh optimisers; returns its iteration. Of trainings whose steps are watched."""
        raise NotImplementedError

    def settles(self, done: int) -> bool:
        """Whether what is trained is handed on after so many steps: there is no way back then."""
        return done == self.iterations

    def told(self, iteration: int, log: TrainingLog) -> tuple[float, str]:
        """How far it is, and in words."""
        last = f", PSNR {log.rows[-1]['psnr']:.1f} dB" if log.rows and "psnr" in log.rows[-1] else ""
        return iteration / self.iterations, f"{self.name}, iteration {iteration} of {self.iterations}{last}"

    def shown(self) -> object:
        """What a `Watch` looks at. Of trainings that are given one."""
        raise NotImplementedError


def train(
    training: Training, log: TrainingLog, run: TrainingRun, begin: Callable[[], None] = lambda: None
) -> None:
    """Do all steps that are left; `begin` is called where there is nothing to take up.

    Raises:
        ReconstructError: The loss diverges with small steps, too.
    """
    saved = run.checkpoint.found(log)
    if saved is None:
        begin()
    else:
        training.generator.set_state(saved.tensors["generator"])
        training.guard.take_up(saved.numbers["guard"])
        training.take_up(saved)
    done = 0 if saved is None else saved.done
    while done < training.iterations:
        step = training.step(done)
        if step is not None and _failed(training, step, done, log):
            where = f"{training.name}, iteration {done}"
            if not training.guard.go_back(log, where):
                raise diverged(f"the loss of {where} ran away")
            done = training.go_back()
            continue
        if done % training.tell_every == 0:
            run.progress(*training.told(done, log))
            if run.watch is not None:
                run.watch(log, training.shown)
        done += 1
        if done % training.keep_every == 0:
            run.checkpoint.keep(done, training.iterations, log, lambda: _state(training))
    log.close_row()


def _state(training: Training) -> State:
    tensors, numbers = training.state()
    tensors = tensors | {"generator": training.generator.get_state()}
    return tensors, numbers | {"guard": training.guard.state()}


def _failed(training: Training, step: Step, iteration: int, log: TrainingLog) -> bool:
    """Log a step; whether the loss has run away, or might have where there is no way back."""
    ran_away = training.guard.ran_away(log, step.rays, step.losses, **step.labels)
    return ran_away or (training.settles(iteration + 1) and not training.guard.sound())
