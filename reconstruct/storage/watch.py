"""Looking at a model now and then while it is trained, off the clock."""

from collections.abc import Callable
from dataclasses import dataclass

from devrf.reconstruct.storage.training_log import TrainingLog

GROWTH = 1.15  # of the gap between two looks


@dataclass
class Watch:
    """When to look next.

    Attributes:
        every_s: Seconds of training to the next look; every gap is longer than the one before, so that a long
            training is looked at no more than a dozen or two times.
        look: Called with the model so far and the seconds that training has taken.
        next_s: When, in seconds of training.
    """

    every_s: float
    look: Callable[..., None]
    next_s: float = 0.0

    def __call__(self, log: TrainingLog, model: Callable[[], object]) -> None:
        """Look if it is time; `model` makes what is looked at."""
        if log.seconds < self.next_s:
            return
        with log.paused():
            self.look(model(), log.seconds)
        self.next_s = log.seconds + self.every_s
        self.every_s *= GROWTH
