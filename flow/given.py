"""Backward flow that a data set brings with its pictures, checked like flow of our own.

The vectors lead to the picture before, in pixels of the size they are stored at, which may be smaller than the
pictures'. There is no flow the other way, so the round trip cannot be measured, and all that the mask leaves counts
alike.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float32

from devrf.flow.pair import Find, PairFlow, Picture

METHOD = "given"  # in flow.json


def given(load_flow: Callable[[int], tuple[Float32[np.ndarray, "h w 2"], Bool[np.ndarray, "h w"]]]) -> Find:
    """Flow of files: `load_flow(n)` gives the n-th frame's vectors, and where they can be trusted."""

    def find(n: int, current: Picture, previous: Picture) -> PairFlow:
        flow, trusted = load_flow(n)
        return PairFlow(flow, None, trusted)

    return find
