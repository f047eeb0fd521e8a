"""Looking at a model now and then while it is trained, off the clock."""

from collections.abc import Callable
from dataclasses import dataclass

from devrf.reconstruct.training_log import TrainingLog


@dataclass
class Watch:
    """When to look next.

    Attributes:
        every_s: Seconds of training between two looks; each gap is a `growth`th longer than the one before, so that
            a long training is looked at no more than a dozen or two times.
        look: Called with the model so far and the seconds that training has taken.
        growth: Of the gaps.
    """

    every_s: float
    look: Callable[..., None]
    growth: float = 0.15
    next_s: float = 0.0

    def __call__(self, log: TrainingLog, model: Callable[[], object]) -> None:
        """Look if it is time; `model` makes what is looked at."""
        if log.seconds < self.next_s:
            return
        with log.paused():
            self.look(model(), log.seconds)
        self.next_s = log.seconds + self.every_s
        self.every_s *= 1 + self.growth
