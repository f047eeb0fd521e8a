"""Tasks on a Ray cluster: CPUs and GPUs are its resources, and what a lost node was doing is handed back as lost.

Ray is asked for no retries of its own: a task begun anew has to wait for the run that the lost node may have left
behind, and the summary is to say what was lost.
"""

import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import devrf
from devrf.capture.cores import usable_cores
from devrf.capture.errors import InputError
from devrf.pipelines.batch.task import Ended, Started, Task, node_name, run_task
from devrf.pipelines.budget.memory import GB
from devrf.pipelines.exit_codes import FAILED, STOPPED

LOOPBACK_ONLY = {
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"
}  # what makes Ray listen on 127.0.0.1 alone, on Linux too
SILENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to Ray's makers
    "RAY_DEDUP_LOGS_SKIP_REGEX": "^",  # a lost node would print pages; what it means is said by the batch
}
KNOCK_S = 5.0  # a head that does not take a connection within this time is not there


class RayCluster:
    """An `Engine` on Ray.

    Args:
        address: HOST:PORT of the cluster, or auto; None starts one on this machine, which only this machine reaches.
        jobs: Tasks at once, which share all cores; None: as many as there is room for.
        cores: Cores of a task where `jobs` does not say; fewer where a node has fewer.
        device: auto, cpu or cuda.
    Raises:
        InputError: Ray is not installed, the cluster is not there, or it has no GPU where one is wished for.
    """

    def __init__(self, address: str | None, jobs: int | None, cores: int, device: str) -> None:
        self._ray = ray = _connected(address)
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        able = [node for node in nodes if node.get("CPU", 0) >= 1 and node.get("memory")]
        if not able:
            ray.shutdown()
            raise InputError(
                f"--address {address}: no node of the cluster has a CPU and memory; start nodes with --num-cpus and "
                "--memory"
            )
        cpus = [int(node["CPU"]) for node in able]
        gpus = int(sum(node.get("GPU", 0) for node in able))
        if device == "cuda" and not gpus:
            ray.shutdown()
            raise InputError(
                "--device cuda: no node of the cluster that has a CPU and memory has a GPU; use --device cpu, or auto"
            )
        self.threads = max(1, min(cores if jobs is None else sum(cpus) // jobs, *cpus))
        per_core = min(node["memory"] / node["CPU"] for node in able)
        self.memory_gb = per_core * self.threads / GB
        self.gpus = gpus if device != "cpu" else 0
        self._most = jobs
        self._remote = ray.remote(num_returns="streaming", max_retries=0)(_carry_out)
        self._waiting: deque[Task] = deque()
        self._running: dict[Any, Task] = {}
        self._begun_s: dict[Any, float] = {}  # when a task was seen to begin
        self.stopping = self._cancelled = False

    def submit(self, task: Task) -> None:
        """Take a task, to be begun as soon as there is room."""
        self._waiting.append(task)
        self._begin_what_fits()

    def events(self, timeout_s: float) -> Sequence[Started | Ended]:
        """What has happened since the last call; waits at most `timeout_s` for something to happen."""
        if self.stopping:
            self._cancel_once()
            never_begun = [Ended(task.scene, STOPPED) for task in self._waiting]
            self._waiting.clear()
            if never_begun:
                return never_begun
        self._begin_what_fits()
        if not self._running:
            time.sleep(timeout_s)
            return []
        # A stream that is cancelled has an end at once, its task has not: that is known by another reference.
        streams = {stream.completed() if self.stopping else stream: stream for stream in self._running}
        if self._ray.wait(list(streams), num_returns=1, timeout=timeout_s)[0]:
            ready, _ = self._ray.wait(list(streams), num_returns=len(streams), timeout=0)
            return [self._next(streams[which]) for which in ready]
        return []

    def stop(self) -> None:
        """Begin nothing more, and end what runs; its ends are among the next `events`."""
        self.stopping = True

    def close(self) -> None:
        """Leave the cluster, or end the one that was started here."""
        self._ray.shutdown()

    def _begin_what_fits(self) -> None:
        """Give tasks to Ray, which begins them when a node has room."""
        while self._waiting and not self.stopping and not len(self._running) == self._most:
            self._begin(self._waiting.popleft())

    def _begin(self, task: Task) -> None:
        remote = self._remote.options(
            num_cpus=task.threads, num_gpus=int(task.gpu), scheduling_strategy="SPREAD"
        )
        self._running[remote.remote(task, devrf.__version__)] = task

    def _cancel_once(self) -> None:
        """Have Ray interrupt what runs; a second time would interrupt it while it ends in order."""
        if not self._cancelled:
            self._cancelled = True
            for stream in self._running:
                self._ray.cancel(stream)

    def _next(self, stream: Any) -> Started | Ended:
        """What a task says next, or what became of it."""
        errors, task = self._ray.exceptions, self._running[stream]
        try:
            event = self._ray.get(next(stream))
        except (errors.TaskCancelledError, StopIteration):  # what a cancelled task says last, Ray drops
            event = Ended(task.scene, STOPPED)
        except errors.RayTaskError as error:
            event = Ended(task.scene, FAILED, f"{task.path}: cannot be run there: {error.cause}")
        except errors.RayError as error:  # the node or its worker died, or Ray ended it to save memory
            event = Ended(task.scene, None, f"a node was lost ({type(error).__name__})")
        if isinstance(event, Started):
            self._begun_s[stream] = time.monotonic()
            return event
        del self._running[stream]
        begun_s = self._begun_s.pop(stream, None)
        if begun_s is not None and not event.seconds:  # it could not say how long it took
            event = replace(event, seconds=time.monotonic() - begun_s)
        return event


def _connected(address: str | None) -> Any:
    """The module `ray`, connected."""
    if address is not None and address != "auto":
        _knock(address)  # Ray itself tries for minutes
    os.environ.update(SILENT if address else SILENT | LOOPBACK_ONLY)
    try:
        import ray
    except ImportError:
        raise InputError(
            "--engine ray: Ray is not installed; pip install 'devrf[ray]', or use --engine local"
        ) from None
    import ray.exceptions

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is None:
            ray.init(address="local", include_dashboard=False, num_cpus=usable_cores(), **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InputError(
            f"--engine ray: no connection to {address or 'a cluster of its own'} ({error}); is ray of the same version "
            "there, and does `ray status` show its nodes?"
        ) from None
    return ray


def _knock(address: str) -> None:
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise InputError(f"--address {address}: expected HOST:PORT, or auto")
    try:
        socket.create_connection((host.strip("[]"), int(port)), KNOCK_S).close()
    except (OSError, OverflowError) as error:
        raise InputError(
            f"--address {address}: nothing answers there ({error}); start the cluster's head with "
            f"ray start --head --port={port}, or leave --address out"
        ) from None


def _carry_out(task: Task, version: str) -> Iterator[Started | Ended]:
    """On a node: run a task. Ray cancels by an interrupt, which ends the run in order, as in the local pool."""
    import ray

    cancelled = threading.Event()
    before = signal.signal(signal.SIGINT, lambda number, frame: cancelled.set())
    try:
        yield Started(task.scene, f"{node_name()}/{ray.get_runtime_context().get_node_id()[:6]}")
        if version != devrf.__version__:
            message = (
                f"{node_name()} has devrf {devrf.__version__}, the batch {version}; install one everywhere"
            )
            yield Ended(task.scene, FAILED, message)
        else:
            yield run_task(task, cancelled.is_set)
    finally:
        signal.signal(signal.SIGINT, before)
