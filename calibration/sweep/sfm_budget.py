"""Time of structure from motion: what is left of it, and how many pairs can be matched in it."""

import time
from collections.abc import Callable, Mapping
from typing import Any

from devrf.calibration.sweep.pairs import Pair, affordable, matching_s, products

MATCH_PROBE = 32  # pairs whose time tells what the others will take
MATCH_SHARE = 0.5  # of the time that is left; mapping takes about as long


class Clock:
    """What is left of a time budget."""

    def __init__(self, budget_s: float | None) -> None:
        self._end = None if budget_s is None else time.monotonic() + budget_s

    def left_s(self) -> float:
        """Seconds; infinite without a budget, never below 0."""
        return float("inf") if self._end is None else max(0.0, self._end - time.monotonic())


class Matching:
    """Pairs matched from the front of the list, as far as they are wanted and time allows."""

    def __init__(
        self,
        pairs: list[Pair],
        wanted: int,
        features: Mapping[str, int],
        match: Callable[[list[Pair]], None],
        clock: Clock,
    ) -> None:
        """`pairs` by worth, of which the first `wanted` are wanted; `features` of each picture; `match` does it."""
        self.pairs, self.wanted, self.features = pairs, wanted, features
        self._match, self._clock = match, clock
        self.matched, self.seconds, self.s_per_product = 0, 0.0, 0.0

    def begin(self) -> None:
        """Measure on the first pairs, then match what is wanted and affordable."""
        self._match_until(min(MATCH_PROBE, self.wanted))
        self.s_per_product = self.seconds / max(1.0, products(self.pairs[: self.matched], self.features))
        self._match_until(min(self.wanted, self._room()))

    def go_on(self) -> bool:
        """Match pairs that were not wanted at first; whether there were any and time for them."""
        room = self._room()
        if self.matched < self.wanted or room <= self.matched:
            return False
        self._match_until(room)
        return True

    def report(self) -> dict[str, Any]:
        """For `static_poses.json`."""
        rest = self.pairs[self.matched : self.wanted]
        return {
            "all": len(self.pairs),
            "wanted": self.wanted,
            "matched": self.matched,
            "seconds": self.seconds,
            "wanted_s": matching_s(self.pairs[: self.wanted], self.features, self.s_per_product),
            "first_skipped": list(rest[0]) if rest else None,
        }

    def _room(self) -> int:
        rest = self.pairs[self.matched :]
        if self._clock.left_s() == float("inf"):
            return len(self.pairs)
        budget_s = MATCH_SHARE * self._clock.left_s()
        return self.matched + affordable(rest, self.features, self.s_per_product, budget_s)

    def _match_until(self, count: int) -> None:
        if count <= self.matched:
            return
        start = time.monotonic()
        self._match(self.pairs[self.matched : count])
        self.seconds += time.monotonic() - start
        self.matched = count
