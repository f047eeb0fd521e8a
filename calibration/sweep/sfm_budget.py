"""Time of structure from motion: what is left of it, and the pairs that are matched in it."""

import time
from collections.abc import Callable
from typing import Any

from devrf.calibration.sweep.pairs import Pair

MATCH_SHARE = 0.5  # of the time that is left; mapping takes about as long
CHUNK = 128  # pairs between two looks at the deadline
GO_ON_S = 900.0  # for pairs that were not wanted at first: all of a long film's may take hours


class Deadline:
    """What is left of a time budget."""

    def __init__(self, budget_s: float | None) -> None:
        self._end = None if budget_s is None else time.monotonic() + budget_s

    def left_s(self) -> float:
        """Seconds; infinite without a budget, never below 0."""
        return float("inf") if self._end is None else max(0.0, self._end - time.monotonic())


class Matching:
    """Pairs matched from the front of the list, as far as they are wanted and time allows."""

    def __init__(
        self, pairs: list[Pair], wanted: int, match: Callable[[list[Pair]], None], deadline: Deadline
    ) -> None:
        """`pairs` by worth, of which the first `wanted` are wanted; `match` does it."""
        self.pairs, self.wanted = pairs, wanted
        self._match, self._deadline = match, deadline
        self.matched, self.seconds = 0, 0.0

    def begin(self) -> None:
        """Match what is wanted, as far as time allows."""
        self._match_until(self.wanted, float("inf"))

    def go_on(self) -> bool:
        """Match pairs that were not wanted at first; whether there were any and time for them."""
        before = self.matched
        if self._deadline.left_s() > 0 and before == self.wanted:
            self._match_until(len(self.pairs), GO_ON_S)
        return self.matched > before

    def report(self) -> dict[str, Any]:
        """For `static_poses.json`."""
        rest = self.pairs[self.matched : self.wanted]
        return {
            "all": len(self.pairs),
            "wanted": self.wanted,
            "matched": self.matched,
            "seconds": self.seconds,
            "first_skipped": list(rest[0]) if rest else None,
        }

    def _match_until(self, count: int, most_s: float) -> None:
        """Match up to a place in the list, or until time is up, but some in any case."""
        least_left_s = MATCH_SHARE * self._deadline.left_s()
        chunk = count if most_s == self._deadline.left_s() == float("inf") else CHUNK
        start = time.monotonic()
        while self.matched < count:
            end = min(self.matched + chunk, count)
            self._match(self.pairs[self.matched : end])
            self.matched = end
            if time.monotonic() - start >= most_s or self._deadline.left_s() <= least_left_s < float("inf"):
                break
        self.seconds += time.monotonic() - start
