"""What carries out tasks: the local pool (`local.py`) or a Ray cluster (`ray_cluster.py`)."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from devrf.pipelines.batch.task import Ended, Started, Task


@runtime_checkable  # what checks types while tests run asks for it
class Engine(Protocol):
    """Carries out tasks side by side, as its resources allow.

    Attributes:
        threads: Cores that each task gets.
        memory_gb: Main memory that each task may hold.
        gpus: GPUs there are.
        stopping: Whether it has been told to stop.
    """

    threads: int
    memory_gb: float
    gpus: int

    @property
    def stopping(self) -> bool: ...

    def submit(self, task: Task) -> None:
        """Take a task, to be begun as soon as there is room."""
        ...

    def events(self, timeout_s: float) -> Sequence[Started | Ended]:
        """What has happened since the last call; waits at most `timeout_s` for something to happen."""
        ...

    def stop(self) -> None:
        """Begin nothing more, and end what runs; its ends are among the next `events`."""
        ...

    def close(self) -> None:
        """Give back what it holds."""
        ...
