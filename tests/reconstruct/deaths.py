"""A training that dies right after it has written certain checkpoints, as often as it is told to."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

from devrf.reconstruct.storage.checkpoint import Checkpoint, Saved

T = TypeVar("T")


class DiesAfter(Checkpoint):
    """A checkpoint that is written after every step and ends the training after some, each once.

    Args:
        path: The file.
        deaths: (phase, steps done) after which to die; the main phase is "".
        phase: This one.
    """

    def __init__(self, path: Path, deaths: set[tuple[str, int]], phase: str = "") -> None:
        super().__init__(path, f"this training {phase}", every_s=0.0)
        self.deaths, self.phase, self.place = deaths, phase, path

    def part(self, name: str) -> "DiesAfter":
        path = Checkpoint(self.place).part(name).path
        assert path is not None
        return DiesAfter(path, self.deaths, name)

    def write(self, saved: Saved) -> bool:
        written = super().write(saved)
        if (self.phase, saved.done) in self.deaths:
            self.deaths.remove((self.phase, saved.done))
            raise KeyboardInterrupt
        return written


def until_done(train: Callable[[Checkpoint], T], folder: Path, deaths: set[tuple[str, int]]) -> T:
    """What a training leaves that dies at all of `deaths` and is begun again each time."""
    left = set(deaths)
    for _ in range(len(deaths) + 1):
        try:
            result = train(DiesAfter(folder / ".state.safetensors", left))
        except KeyboardInterrupt:
            continue
        if left:
            pytest.fail(f"never came by {left}")
        return result
    pytest.fail("never finished")
