"""What one stage may use, handed to it by the runner."""

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Allowance:
    """None everywhere: as much as there is.

    Attributes:
        memory: Main memory of a training with the process around it, bytes.
        gpu: Memory of the GPU that a training may take, bytes.
        at_once: Pictures, pairs or threads to work on at once.
        side_px: Longer side to which pictures of the sweep are reduced for structure from motion.
        until: When it should be done, on the clock of `time.monotonic`, seconds.
    """

    memory: int | None = None
    gpu: int | None = None
    at_once: int | None = None
    side_px: int | None = None
    until: float | None = None

    @property
    def left_s(self) -> float | None:
        """Seconds it has left; None: as long as it takes."""
        return None if self.until is None else max(0.0, self.until - time.monotonic())


UNBOUNDED = Allowance()
