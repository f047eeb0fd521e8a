"""A small scene as methods get it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from devrf.capture.formats.datasets import read_dataset
from devrf.flow.dis import DisFlow
from devrf.lab.methods.method_table import Regime
from devrf.lab.methods.pictures import Space
from devrf.lab.methods.protocol import MethodTask
from devrf.reconstruct.options import preset

MakeTask = Callable[..., MethodTask]


@pytest.fixture(scope="session", autouse=True)
def silhouettes_once() -> Iterator[None]:
    """The space of the small scene is found once for each regime: it takes a second."""
    found: dict[Regime, Space] = {}
    of = Space.of

    def once(task: MethodTask) -> Space:
        if task.regime not in found:
            found[task.regime] = of(task)
        return found[task.regime]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Space, "of", staticmethod(once))
        yield


@pytest.fixture(scope="session")
def task(arm: Path) -> MakeTask:
    """Makes a task of the arm, 32 x 32 pictures of three moments, for a regime."""
    scene = read_dataset("devrf", arm)

    def make(regime: Regime = "joint") -> MethodTask:
        return MethodTask(scene, {}, regime, "small", "cpu", 0, lambda name: preset(name), DisFlow)

    return make
