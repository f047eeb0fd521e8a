"""Tasks side by side on this machine: so many at once, or one on each GPU."""

import queue
import threading
from collections.abc import Callable

from devrf.pipelines.batch.task import Ended, Task, run_task
from devrf.pipelines.terminal.exit_codes import STOPPED


class LocalPool:
    """Processes on this machine, each waited for by the thread that asks for it.

    Args:
        jobs: Tasks at once.
        threads: Cores that each task gets.
        memory_gb: Main memory that each task may hold.
        gpus: GPUs; each task gets one of its own where there are any, so that no more run at once.
    Attributes:
        at_once: Tasks that can run at once: so many threads ask for a place.
        stopped: Set, nothing more is begun, and what runs is ended in order.
    """

    def __init__(self, jobs: int, threads: int, memory_gb: float, gpus: int) -> None:
        self.threads, self.memory_gb, self.gpus = threads, memory_gb, gpus
        self.stopped = threading.Event()
        self._places: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self.at_once = min(jobs, gpus or jobs)
        for place in range(self.at_once):
            self._places.put(place if gpus else None)

    def run(self, task: Task, begun: Callable[[], None]) -> Ended:
        """Carry out a task as soon as there is room.

        Args:
            task: What to run.
            begun: Told once it begins.
        """
        gpu = self._places.get()
        try:
            if self.stopped.is_set():
                return Ended(STOPPED)
            begun()
            return run_task(task, self.stopped.is_set, gpu)
        finally:
            self._places.put(gpu)
