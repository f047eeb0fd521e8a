"""What an optical-flow estimator is.

Flow from picture 0 to picture 1 says where each pixel of picture 0 went: a pixel centred at (x, y) of
picture 0 shows at (x + u, y + v) of picture 1; u right, v down, pixels. The interface is RAFT's (RGB in,
any size), so that methods can be exchanged. Validity comes with it by asking both ways (`consistency.both_ways`).
"""

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from devrf.capture.system.errors import InputError
from devrf.flow.methods import installed, mistake


@runtime_checkable
class FlowEstimator(Protocol):
    """Optical flow between two pictures of one size.

    Attributes:
        name: What it is called in flow.json.
        parallel: Whether threads may ask it at the same time, which then pays; else it is asked one by one.
    """

    name: str
    parallel: bool

    def estimate(
        self,
        image0: UInt8[np.ndarray, "*batch height width 3"],
        image1: UInt8[np.ndarray, "*batch height width 3"],
    ) -> Float32[np.ndarray, "*batch height width 2"]:
        """Flow [..., height, width, 2] (u right, v down, pixels) from image0 to image1 (RGB)."""
        ...


def takes_contrast(estimator: FlowEstimator) -> bool:
    """Whether a method is better shown the contrast of brightness, in grey, where light changes between two pictures.

    A method says so by an attribute of this name. One that has none is shown pictures in their colours, as those are by
    which methods are learned.
    """
    return getattr(estimator, "takes_contrast", False)


def create_estimator(method: str, weights: Path | None = None, device: str = "cpu") -> FlowEstimator:
    """The estimator called `method`.

    Args:
        method: One of `methods()`.
        weights: File of a learned estimator's weights.
        device: cpu or cuda; DIS stays on the CPU.
    Raises:
        InputError: A `mistake`; weights that do not fit; an installed method that is no estimator.
    """
    if wrong := mistake(method, weights):
        raise InputError("method-unusable", f"flow: {wrong}")
    if method == "dis":
        from devrf.flow.dis import DisFlow

        return DisFlow()
    if method == "raft":
        from devrf.flow.raft.raft import RaftFlow

        assert weights is not None  # checked
        return RaftFlow(weights, device)
    point = installed()[method]
    try:
        estimator = point.load()(weights, device)
    except Exception as error:  # somebody else's code: whatever it raises, the user is told whose it is
        text = f"flow.method: {method}: {point.value} cannot be used ({type(error).__name__}: {error})"
        raise InputError("method-unusable", text) from error
    if not isinstance(estimator, FlowEstimator):
        wrong = f"flow.method: {method}: {point.value} gave {type(estimator).__name__}"
        expected = "an estimator with name, parallel and estimate(image0, image1)"
        raise InputError("method-unusable", f"{wrong}, expected {expected}")
    return estimator
