"""A small scene as methods get it."""

from collections.abc import Callable
from pathlib import Path

import pytest

from devrf.capture.formats.datasets import read_dataset
from devrf.flow.dis import DisFlow
from devrf.lab.methods.method_table import Regime
from devrf.lab.methods.protocol import MethodTask
from devrf.reconstruct.options import preset

MakeTask = Callable[..., MethodTask]


@pytest.fixture(scope="session")
def task(arm: Path) -> MakeTask:
    """Makes a task of the arm, 32 x 32 pictures of three moments, for a regime."""
    scene = read_dataset("devrf", arm)

    def make(regime: Regime = "joint") -> MethodTask:
        return MethodTask(scene, {}, regime, "small", "cpu", 0, lambda name: preset(name), DisFlow)

    return make
