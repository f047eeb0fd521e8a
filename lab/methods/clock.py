"""A training within a budget: how much of it is spent, and looks at the model, whose time does not count."""

import time

from jaxtyping import Float
from torch import Tensor

from devrf.lab.methods.protocol import TimeBudget, TrainedModel
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.watch import Watch

LOOKS = 12  # at the model while it is trained, about
EVERY = 20  # steps between two checks that the loss is a number


def timed(device: str, every: int = EVERY) -> TrainingLog:
    """A log that begins now: on a CPU it counts processor seconds, so that other programs beside it do not count.

    With one thread on an idle core these are the seconds of a wall's clock; those of several threads add up.
    """
    return TrainingLog(device, every, time.process_time if device == "cpu" else time.perf_counter)


class TrainingClock:
    """The seconds and steps of a training."""

    def __init__(self, budget: TimeBudget, device: str) -> None:
        self._budget, self._log = budget, timed(device)
        self._watch = Watch(budget.seconds / LOOKS, budget.look)

    @property
    def steps(self) -> int:
        """That are done."""
        return self._log.iteration

    @property
    def share(self) -> float:
        """Of the budget that is spent, by time or by steps."""
        steps = 0.0 if self._budget.steps is None else self.steps / self._budget.steps
        return min(1.0, max(self._log.seconds / self._budget.seconds, steps))

    def step(self, model: TrainedModel, rays: int, loss: Float[Tensor, ""]) -> None:
        """A step is done; look at the model if it is time to, and when the budget is spent.

        Raises:
            Diverged: The loss is no number.
        """
        self._log.add(rays, {"loss": loss})
        share = self.share
        self._budget.progress(share, f"step {self.steps}")
        if share < 1:
            self._watch(self._log, lambda: model)
            return
        self._log.close_row()
        with self._log.paused():
            self._budget.look(model, self._log.seconds)
