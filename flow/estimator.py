"""What an optical-flow estimator is, and which ones there are.

Flow from picture 0 to picture 1 says where each pixel of picture 0 went: a pixel centred at (x, y) of
picture 0 shows at (x + u, y + v) of picture 1; u right, v down, pixels. The interface is RAFT's (RGB in,
any size), so that methods can be exchanged.
"""

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from devrf.capture.errors import InputError


@runtime_checkable
class FlowEstimator(Protocol):
    """Optical flow between two pictures of one size."""

    name: str

    def estimate(
        self,
        image0: UInt8[np.ndarray, "*batch height width 3"],
        image1: UInt8[np.ndarray, "*batch height width 3"],
    ) -> Float32[np.ndarray, "*batch height width 2"]:
        """Flow [..., height, width, 2] (u right, v down, pixels) from image0 to image1 (RGB)."""
        ...


def create_estimator(method: str, weights: Path | None = None) -> FlowEstimator:
    """The estimator called `method`.

    Raises:
        InputError: A method that is not built in. RAFT is refused and never replaced by DIS in silence: the
            two do not give the same result.
    """
    if method == "dis":
        from devrf.flow.dis import DisFlow

        return DisFlow()
    if method == "raft":
        raise InputError(
            f"flow.method: raft (weights {weights}) is not available in this version, expected dis; "
            "set flow.method: dis"
        )
    raise InputError(f"flow.method: {method!r} is not known, expected dis or raft")
