"""What an optical-flow estimator is, and which ones there are.

Flow from picture 0 to picture 1 says where each pixel of picture 0 went: a pixel centred at (x, y) of
picture 0 shows at (x + u, y + v) of picture 1; u right, v down, pixels. The interface is RAFT's (RGB in,
any size), so that methods can be exchanged. Validity comes with it by asking both ways (`consistency.both_ways`).

A package of your own adds a method by an entry point of the group `devrf.flow`: its name is the method's, and it
leads to a function of `(weights: Path | None, device: str)` that gives a `FlowEstimator`.
"""

from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from devrf.capture.errors import InputError

GROUP = "devrf.flow"
BUILT_IN = ("dis", "raft")
Preset = Literal["ultrafast", "fast", "medium"]  # of DIS


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


def methods() -> tuple[str, ...]:
    """Names of all estimators that there are: those built in, then those of installed packages."""
    return (*BUILT_IN, *sorted(_installed().keys() - set(BUILT_IN)))


def mistake(method: str, weights: str | Path | None, preset: str | None = None) -> str | None:
    """What is wrong with a choice: a method that is not there, weights or a preset that it lacks or cannot use.

    No method is ever replaced by another in silence: no two give the same.
    """
    if method not in BUILT_IN and method not in methods():
        return (
            f"method {method!r} is not known, expected {', '.join(methods())}; an installed package adds a method "
            f"by an entry point of the group {GROUP}"
        )
    if method == "raft" and weights is None:
        return "weights is missing; method raft needs the authors' checkpoint or torchvision's state dict"
    if method == "dis" and weights is not None:
        return (
            f"weights {str(weights)!r} are of no use; method dis needs none: remove them, or set method: raft"
        )
    if method != "dis" and preset is not None:
        return f"preset {preset!r} is of no use; only method dis has presets: remove it"
    return None


def create_estimator(
    method: str, weights: Path | None = None, device: str = "cpu", preset: Preset | None = None
) -> FlowEstimator:
    """The estimator called `method`.

    Args:
        method: One of `methods()`.
        weights: File of a learned estimator's weights.
        device: cpu or cuda; DIS stays on the CPU.
        preset: Of DIS; default: medium.
    Raises:
        InputError: A `mistake`; weights that do not fit; an installed method that is no estimator.
    """
    if wrong := mistake(method, weights, preset):
        raise InputError(f"flow: {wrong}")
    if method == "dis":
        from devrf.flow.dis import DisFlow

        return DisFlow(preset or "medium")
    if method == "raft":
        from devrf.flow.raft import RaftFlow

        assert weights is not None  # checked
        return RaftFlow(weights, device)
    point = _installed()[method]
    try:
        estimator = point.load()(weights, device)
    except Exception as error:  # somebody else's code: whatever it raises, the user is told whose it is
        raise InputError(
            f"flow.method: {method}: {point.value} cannot be used ({type(error).__name__}: {error})"
        ) from error
    if not isinstance(estimator, FlowEstimator):
        raise InputError(
            f"flow.method: {method}: {point.value} gave {type(estimator).__name__}, expected an estimator with "
            "name, parallel and estimate(image0, image1)"
        )
    return estimator


def plug_in(method: str) -> str | None:
    """The module of an installed package that a method comes from; None for those built in."""
    return None if method in BUILT_IN else _installed()[method].module


def _installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group=GROUP)}
