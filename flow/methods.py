"""Which methods of optical flow there are, and what can be asked of each. Needs no library.

A package of your own adds a method by an entry point of the group `devrf.flow`: its name is the method's, and it
leads to a function of `(weights: Path | None, device: str)` that gives a `FlowEstimator`.
"""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "devrf.flow"
BUILT_IN = ("dis", "raft")


def methods() -> tuple[str, ...]:
    """Names of all estimators that there are: those built in, then those of installed packages."""
    return (*BUILT_IN, *sorted(installed().keys() - set(BUILT_IN)))


def mistake(method: str, weights: str | Path | None) -> str | None:
    """What is wrong with a choice: a method that is not there, weights that it lacks or cannot use.

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
    return None


def plug_in(method: str) -> str | None:
    """The module of an installed package that a method comes from; None for those built in."""
    return None if method in BUILT_IN else installed()[method].module


def installed(group: str = GROUP) -> "dict[str, EntryPoint]":
    """The estimators of installed packages, or what else they add by a `group`, by their names."""
    from importlib.metadata import entry_points  # takes a while, and most ask for a method that is built in

    return {point.name: point for point in entry_points(group=group)}
