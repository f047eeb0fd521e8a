"""What one stage may use, handed to it by the runner."""

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Allowance:
    """None everywhere: as much as there is.

    Attributes:
        memory: Main memory of the stage with the process around it, bytes.
        gpu: Memory of the GPU that a training may take, bytes.
        until: When it should be done, on the clock of `time.monotonic`, seconds.
    """

    memory: int | None = None
    gpu: int | None = None
    until: float | None = None

    @property
    def left_s(self) -> float | None:
        """Seconds it has left; None: as long as it takes."""
        return None if self.until is None else max(0.0, self.until - time.monotonic())


UNBOUNDED = Allowance()
