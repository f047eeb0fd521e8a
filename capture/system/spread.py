"""A few of many: all that need not be looked at one by one is looked at evenly."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Item = TypeVar("Item")


def spread(items: Sequence[Item], most: int) -> list[Item]:
    """At most so many of them, evenly spread, the first and the last among them; of one alone the one in the middle."""
    if most == 1:
        return list(items[len(items) // 2 :][:1])
    at = np.linspace(0, len(items) - 1, min(len(items), most)).round().astype(int)
    return [items[n] for n in at.tolist()]
