"""A training that runs away is caught: it goes on from its last good point, with smaller steps.

Steps that are too large throw a model further than its gradient can tell: the loss leaps up and stays there, or stops
being a number. Batches of rays differ by tenths, so a loss that has doubled has not done so by chance. Only too large a
step, or numbers without an end, can be helped that way; where smaller ones do not help, the caller is told.
"""

import logging
import math
from statistics import median
from typing import Any

from torch import Tensor

from devrf.capture.errors import ReconstructError
from devrf.reconstruct.training_log import Diverged, TrainingLog

LOOK_EVERY = 5  # iterations; their median is what is compared
RUNAWAY = 2.0  # times the lowest loss since the last good point
WORSE = 1.26  # 1 dB: how much worse what was trained may fit its pictures than before
SMALLER = 1 / 3  # a step in place of one that ran away
MOST = 4  # steps back to one good point: the last try is with steps of 1/81

logger = logging.getLogger(__name__)


class Guard:
    """Watches the losses of one training.

    Attributes:
        rate: By which all learning rates are to be multiplied.
        restarts: How often it went back to a good point.
    """

    def __init__(self) -> None:
        self.rate, self.restarts = 1.0, 0
        self._here = 0  # steps back to the present good point
        self._rate_here = 1.0  # with which it was come to
        self.begin()

    def begin(self) -> None:
        """Other pictures, or another model, from here on: losses before do not compare."""
        self._first: float | None = None
        self._lowest = math.inf
        self._recent: list[Tensor] = []
        self._last = math.nan

    def good_point(self) -> None:
        """What is trained is as it should be, and is what is gone back to."""
        self._here, self._rate_here = 0, self.rate

    def ran_away(self, log: TrainingLog, rays: int, parts: dict[str, Tensor], **labels: float) -> bool:
        """Log an iteration; whether the loss has run away since the last good point."""
        try:
            log.add(rays, parts, **labels)
        except Diverged:
            return True
        if "mse" not in parts:
            return False
        self._recent.append(parts["mse"].detach())
        if self._first is None:
            self._first = self._lowest = float(self._recent[0])
        if len(self._recent) < LOOK_EVERY:
            return not math.isfinite(self._first)
        losses = [float(loss) for loss in self._recent]
        self._recent = []
        self._last = median(losses)
        if not all(map(math.isfinite, losses)) or self._last > RUNAWAY * self._lowest:
            return True
        self._lowest = min(self._lowest, self._last)
        return False

    def made_it_worse(self) -> bool:
        """Whether what was trained fits its pictures clearly worse than before the first step."""
        return self._first is not None and self._last > WORSE * self._first

    @property
    def hopeless(self) -> bool:
        """Whether the loss was no number before the first step."""
        return self._first is not None and not math.isfinite(self._first)

    def go_back(self, log: TrainingLog, where: str) -> bool:
        """Say so, and take smaller steps from now on; False: it was tried often enough, and the rate is as before."""
        log.forget()
        self.begin()
        if self._here == MOST:
            self.rate = self._rate_here
            logger.warning("%s: training gets worse however small its steps are", where)
            return False
        self._here, self.restarts, self.rate = self._here + 1, self.restarts + 1, SMALLER * self.rate
        logger.warning(
            "%s: the loss ran away; training goes on from the last good point with steps of %.2g times the size",
            where,
            self.rate,
        )
        return True

    def state(self) -> dict[str, Any]:
        """All of it as plain numbers, for a checkpoint."""
        kept = {name: value for name, value in vars(self).items() if name != "_recent"}
        return kept | {"_recent": [float(loss) for loss in self._recent]}

    def take_up(self, state: dict[str, Any]) -> None:
        """Go on from a `state`."""
        vars(self).update(state)

    def summary(self) -> dict[str, Any]:
        """As written to metrics.json."""
        return {"restarts": self.restarts, "rate": self.rate}


def diverged(where: str) -> ReconstructError:
    """What is said where smaller steps do not help."""
    return ReconstructError(
        f"training diverged: {where}, and smaller steps do not help; check poses and times (report), then lower "
        "reconstruct.learning_rate or reconstruct.resolution, or change the seed"
    )
