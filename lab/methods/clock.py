"""How much of a budget is spent; a dozen looks at the model stand beside it."""

import time

from devrf.lab.methods.protocol import Budget, Trained

LOOKS = 12  # at the model while it is trained


class Clock:
    """The seconds of a training.

    Attributes:
        steps: That are done.
    """

    def __init__(self, budget: Budget) -> None:
        self._budget, self.steps, self._seconds, self._looked = budget, 0, 0.0, 0
        self._since = time.perf_counter()

    @property
    def share(self) -> float:
        """Of the budget that is spent, by time or by steps."""
        spent = (self._seconds + time.perf_counter() - self._since) / self._budget.seconds
        steps = 0.0 if self._budget.steps is None else self.steps / self._budget.steps
        return min(1.0, max(spent, steps))

    def step(self, model: Trained) -> None:
        """A step is done; look at the model if it is time to."""
        self.steps += 1
        share = self.share
        self._budget.progress(share, f"step {self.steps}")
        if share * LOOKS >= self._looked + 1:
            self._seconds += time.perf_counter() - self._since
            self._budget.look(model, self._seconds)
            self._looked = int(share * LOOKS)
            self._since = time.perf_counter()
