"""Tasks side by side on this machine: so many at once, and one at a time on each GPU."""

import queue
import threading
from collections.abc import Callable

from devrf.pipelines.batch.task import Ended, Task, node_name, run_task
from devrf.pipelines.exit_codes import STOPPED


class LocalPool:
    """Processes on this machine, each waited for by the thread that asks for it.

    Args:
        jobs: Tasks without a GPU at once.
        threads: Cores that each task gets.
        memory_gb: Main memory that each task may hold.
        gpus: GPUs, for tasks that need one.
    Attributes:
        stopped: Set, nothing more is begun, and what runs is ended in order.
    """

    def __init__(self, jobs: int, threads: int, memory_gb: float, gpus: int) -> None:
        self.threads, self.memory_gb, self.gpus = threads, memory_gb, gpus
        self.stopped = threading.Event()
        self._cores: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._gpus: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        for _ in range(jobs):
            self._cores.put(None)
        for gpu in range(gpus):
            self._gpus.put(gpu)

    def run(self, task: Task, begun: Callable[[str], None]) -> Ended:
        """Carry out a task as soon as there is room.

        Args:
            task: What to run.
            begun: Told where, once it begins.
        """
        places = self._gpus if task.gpu else self._cores
        gpu = places.get()
        try:
            if self.stopped.is_set():
                return Ended(STOPPED)
            begun(node_name())
            return run_task(task, self.stopped.is_set, gpu)
        finally:
            places.put(gpu)
