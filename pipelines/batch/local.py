"""Tasks side by side on this machine: so many at once, and one at a time on each GPU."""

import contextlib
import queue
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from devrf.pipelines.batch.task import Ended, Started, Task, node_name, run_task
from devrf.pipelines.exit_codes import FAILED, STOPPED


class LocalPool:
    """An `Engine` of threads, each of which waits for the process of one task.

    Args:
        jobs: Tasks without a GPU at once.
        threads: Cores that each task gets.
        memory_gb: Main memory that each task may hold.
        gpus: GPUs, for tasks that need one.
    """

    def __init__(self, jobs: int, threads: int, memory_gb: float, gpus: int) -> None:
        self.threads, self.memory_gb, self.gpus = threads, memory_gb, gpus
        self._stopped = threading.Event()
        self._events: queue.SimpleQueue[Started | Ended] = queue.SimpleQueue()
        self._free_gpus: queue.SimpleQueue[int] = queue.SimpleQueue()
        for n in range(gpus):
            self._free_gpus.put(n)
        self._pools = {
            False: ThreadPoolExecutor(jobs, "batch"),
            True: ThreadPoolExecutor(max(1, gpus), "batch-gpu"),
        }

    @property
    def stopping(self) -> bool:
        """Whether it has been told to stop."""
        return self._stopped.is_set()

    def submit(self, task: Task) -> None:
        """Take a task, to be begun as soon as there is room."""
        self._pools[task.gpu].submit(self._run, task)

    def events(self, timeout_s: float) -> Sequence[Started | Ended]:
        """What has happened since the last call; waits at most `timeout_s` for something to happen."""
        found: list[Started | Ended] = []
        with contextlib.suppress(queue.Empty):
            found.append(self._events.get(timeout=timeout_s))
            while True:
                found.append(self._events.get_nowait())
        return found

    def stop(self) -> None:
        """Begin nothing more, and end what runs; its ends are among the next `events`."""
        self._stopped.set()

    def close(self) -> None:
        """Wait for the threads."""
        self.stop()
        for pool in self._pools.values():
            pool.shutdown()

    def _run(self, task: Task) -> None:
        if self._stopped.is_set():
            self._events.put(Ended(task.scene, STOPPED))
            return
        self._events.put(Started(task.scene, node_name()))
        gpu = self._free_gpus.get() if task.gpu else None
        try:
            self._events.put(run_task(task, self._stopped.is_set, gpu))
        except Exception as error:  # a thread has nobody to tell
            self._events.put(Ended(task.scene, FAILED, f"{task.path}: cannot be run here: {error}"))
        finally:
            if gpu is not None:
                self._free_gpus.put(gpu)
