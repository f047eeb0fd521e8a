"""A training that runs away is caught: it goes on from its last good point, with smaller steps.

Steps that are too large throw a model further than its gradient can tell: the loss leaps up and stays there, or stops
being a number. Batches of rays of all pictures mostly differ by tenths, so a loss that has doubled has not done so by
chance (where it may, the caller looks again). Where what is left is in a few rays, as of clean pictures that are nearly
explained, they differ severalfold: how much is measured, and a run-away is what is beyond it. Only too large a step, or
numbers without an end, can be helped that way; where smaller ones do not help, the caller is told.
"""

import logging
import math
from statistics import median
from typing import Any

from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.storage.training_log import Diverged, TrainingLog

LOOK_EVERY = 5  # iterations; their median is what is compared
RUNAWAY = 2.0  # times the lowest loss of the same pictures
CHANCE = 7.0  # spreads of the logarithm of a loss: the lowest of hundreds of medians against another; 2 trips of 1000
CHANGES, ENOUGH_CHANGES = 120, 15  # from one look to the next, by which that is measured
SMALLER = 1 / 3  # a step in place of one that ran away
MOST = 4  # steps back to one good point: the last try is with steps of 1/81

logger = logging.getLogger(__name__)


class Guard:
    """Watches the losses of one training.

    Attributes:
        look_every: Iterations that are looked at together; where batches take turns, whole rounds of them.
        rate: By which all learning rates are to be multiplied.
        restarts: How often it went back to a good point.
    """

    def __init__(self) -> None:
        self.look_every = LOOK_EVERY
        self.rate, self.restarts = 1.0, 0
        self._smallest = 1.0  # rate with which a good point was come to
        self._here = 0  # steps back to the present good point
        self._rate_here = 1.0  # with which it was come to
        self._odd = False  # the good point before was the first one that smaller steps were needed at
        self.begin()

    def begin(self, lowest: float | None = None) -> None:
        """Losses before do not compare: another model, or its beginning, whose loss may be known."""
        self._pictures = ""
        self._lowest: dict[str, float] = {} if lowest is None else {self._pictures: lowest}
        self._lowest_here = dict(self._lowest)
        self._changes: list[float] = []  # of logarithms of losses, without what all of a look have in common
        self._changes_here: list[float] = []
        self._before: list[float] = []  # losses of the look before
        self._recent: list[Tensor] = []
        self._new = 0  # of these, not looked at

    def turn_to(self, pictures: str) -> None:
        """Batches are of other pictures from here on: each are compared with themselves only."""
        self._pictures, self._recent, self._new, self._before = pictures, [], 0, []

    def good_point(self) -> None:
        """What is trained is as it should be, and is what is gone back to."""
        self._smallest = min(self._smallest, self.rate)
        self._here, self._rate_here, self._lowest_here = 0, self.rate, dict(self._lowest)
        self._changes_here = list(self._changes)

    def other_part(self) -> None:
        """A good point of another part of the model: steps as before, unless two parts on end needed smaller ones."""
        needed = self.shrunk < 1
        self._smallest = min(self._smallest, self.rate)
        if needed and not self._odd:
            self.rate = self._rate_here
        self._odd = needed
        self.good_point()

    @property
    def shrunk(self) -> float:
        """Size of the steps, of those with which the good point was come to."""
        return self.rate / self._rate_here

    def ran_away(self, log: TrainingLog, rays: int, parts: dict[str, Tensor], **labels: float) -> bool:
        """Log an iteration; whether the loss has run away."""
        try:
            log.add(rays, parts, **labels)
        except Diverged:
            return True
        if "mse" not in parts:
            return False
        self._recent = [*self._recent[1 - self.look_every :], parts["mse"].detach()]
        self._new += 1
        if self._pictures not in self._lowest:
            self._lowest[self._pictures] = float(self._recent[-1])
            return not math.isfinite(self._lowest[self._pictures])
        if self._new < self.look_every:
            return False
        self._new = 0
        losses = [float(loss) for loss in self._recent]
        now, lowest = median(losses), self._lowest[self._pictures]
        self._lowest[self._pictures] = min(lowest, now)
        if not all(map(math.isfinite, losses)) or now > _by_chance(self._changes) * lowest:
            return True
        self._changes = [*self._changes, *_changed(self._before, losses)][-CHANGES:]
        self._before = losses
        return False

    def sound(self) -> bool:
        """Whether the last losses, looked at or not, are those of a model to keep: a leap shows in two on end."""
        losses = [float(loss) for loss in self._recent]
        if not all(map(math.isfinite, losses)):
            return False
        return len(losses) < 2 or min(losses[-2:]) <= _by_chance(self._changes) * self._lowest[self._pictures]

    def go_back(self, log: TrainingLog, where: str) -> bool:
        """Say so, and take smaller steps from now on; False: it was tried often enough, and the rate is as before."""
        log.forget()
        self._lowest, self._recent, self._new = dict(self._lowest_here), [], 0
        self._changes, self._before = list(self._changes_here), []
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
        """As written to metrics.json: `rate` is the smallest with which anything was trained that was kept."""
        return {"restarts": self.restarts, "rate": min(self._smallest, self.rate)}


def _by_chance(changes: list[float]) -> float:
    """How many times its lowest value a loss may be without having run away."""
    if len(changes) < ENOUGH_CHANGES:
        return RUNAWAY
    # a change is the difference of two losses
    spread = 1.4826 * median(map(abs, changes)) / math.sqrt(2)
    return max(RUNAWAY, math.exp(CHANCE * spread))


def _changed(before: list[float], losses: list[float]) -> list[float]:
    """How losses changed since the look before; cameras that take turns stand at the same places in both."""
    if len(before) != len(losses) or min(*before, *losses) <= 0:
        return []
    changes = [math.log(a / b) for a, b in zip(losses, before, strict=True)]
    trend = median(changes)
    return [change - trend for change in changes]


def diverged(where: str) -> ReconstructError:
    """What is said where smaller steps do not help."""
    remedy = "check poses and times (report), then lower reconstruct.resolution"
    text = f"training diverged: {where}, and smaller steps do not help; {remedy}, or change the seed"
    return ReconstructError("training-diverged", text)
