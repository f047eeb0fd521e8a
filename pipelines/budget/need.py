"""What a stage needs, and how many pictures it may work on at once so that it keeps within what is allowed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from devrf.capture.errors import DevrfError


class BudgetError(DevrfError):
    """A stage that cannot be done with what a run may use."""


@dataclass(frozen=True)
class Need:
    """Of one stage; all but the seconds in bytes.

    Attributes:
        stage: Its name.
        base: Main memory that it takes whatever is done, libraries and all.
        each: And for each picture, pair or thread that it works on at once.
        at_once: Most that it works on at once.
        gpu: Memory of the GPU, where there is one.
        left: What its folder holds on the disk in the end.
        passing: What it writes beside that while it works.
        seconds: On two CPU cores; None where nobody has measured it.
    """

    stage: str
    base: int
    each: int = 0
    at_once: int = 1
    gpu: int = 0
    left: int = 0
    passing: int = 0
    seconds: float | None = 0.0

    @property
    def least(self) -> int:
        """Main memory with one picture at a time, bytes."""
        return self.base + self.each

    @property
    def disk(self) -> int:
        """Most that it has on the disk while it works, bytes."""
        return self.left + self.passing

    def fitted(self, allowed: int) -> int:
        """How many it may work on at once within `allowed` bytes; 0 where not even one fits."""
        if not self.each:
            return self.at_once if self.base <= allowed else 0
        return max(0, min(self.at_once, (allowed - self.base) // self.each))


def most_on_disk(needs: Iterable[Need], replaced: Mapping[str, int] | None = None) -> int:
    """Most that some stages, one after the other, add to the disk, bytes.

    Args:
        needs: Of the stages.
        replaced: Bytes of finished folders that go once the stage has been made again, by stage.
    """
    left = most = 0
    for need in needs:
        most = max(most, left + need.disk)
        left += need.left - (replaced or {}).get(need.stage, 0)
    return most
