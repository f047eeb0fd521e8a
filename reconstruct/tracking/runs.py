"""Runs through time on disk, so that a tracking that was killed, or whose time is over, goes on where it was."""

from collections.abc import Callable

import numpy as np
import torch

from devrf.reconstruct.storage.checkpoint import Checkpoint, Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog

Arrays = dict[str, np.ndarray]


class Runs:
    """The state of each run by its name: where one that has not ended goes on, and the result of one that has."""

    def __init__(self, checkpoint: Checkpoint, points: int, log: TrainingLog) -> None:
        """Take up what a checkpoint has of as many points, if anything, and the seconds that it took."""
        self._checkpoint, self._points, self._log = checkpoint, points, log
        self._done, self._states = 0, dict[str, Arrays]()
        saved = checkpoint.found(self._log)
        if saved is not None and saved.numbers.get("points") == points:
            self._done = saved.done
            for name, tensor in saved.tensors.items():
                run, what = name.split("/")
                self._states.setdefault(run, {})[what] = tensor.numpy()

    def of(self, run: str) -> Arrays | None:
        """The state of a run that has begun."""
        return self._states.get(run)

    def moved_on(self, run: str, left: int, state: Callable[[], Arrays]) -> None:
        """A run has come one moment further; its state is written if it is time to.

        Args:
            run: Its name.
            left: Moments to its end.
            state: Makes the state.
        Raises:
            OutOfTime: The time of all is over; the state is written.
        """
        self._done += 1
        if not left:
            self._states[run] = state()

        def everything() -> State:
            self._states[run] = state()
            return self._state()

        self._checkpoint.keep(self._done, self._done + left, self._log, everything)

    def write(self) -> None:
        """Write the states of all runs now."""
        tensors, numbers = self._state()
        self._checkpoint.write(Saved(self._done, tensors, numbers | {"log": self._log.state()}))

    def _state(self) -> State:
        tensors = {
            f"{run}/{name}": torch.from_numpy(array)
            for run, arrays in self._states.items()
            for name, array in arrays.items()
        }
        return tensors, {"points": self._points}
