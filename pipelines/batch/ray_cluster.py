"""Tasks on a Ray cluster: CPUs and GPUs are its resources, and what a lost node was doing is handed back as lost.

Ray is asked for no retries of its own: a task begun anew has to wait for the run that the lost node may have left
behind, and the summary is to say what was lost.
"""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import devrf
from devrf.capture.cores import usable_cores
from devrf.capture.errors import InputError
from devrf.pipelines.batch.task import Ended, Task, node_name, run_task
from devrf.pipelines.budget.memory import GB
from devrf.pipelines.exit_codes import FAILED, STOPPED

# what makes Ray listen on 127.0.0.1 alone, on Linux too
LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
SILENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to Ray's makers
    "RAY_DEDUP_LOGS_SKIP_REGEX": "^",  # a lost node would print pages; what it means is said by the batch
}
TICK_S = 1.0  # between two looks at whether to stop; a thousand threads look
MOST = 1 << 20  # tasks at once where nobody says how many: as Ray has room
KNOCK_S = 5.0  # a head that does not take a connection within this time is not there


class RayCluster:
    """A Ray cluster; each of its tasks is waited for by the thread that asks for it.

    Args:
        address: HOST:PORT of the cluster, or auto; None starts one on this machine, which only this machine reaches.
        jobs: Tasks at once, which share all cores; None: as many as there is room for.
        cores: Cores of a task where `jobs` does not say; fewer where a node has fewer.
        device: auto, cpu or cuda.
    Attributes:
        threads, memory_gb: Cores and main memory that each task gets.
        gpus: GPUs there are.
        stopped: Set, nothing more is begun, and what runs is ended in order.
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
                "cluster-without-memory",
                f"--address {address}: no node of the cluster has a CPU and memory; start nodes with --num-cpus and "
                "--memory",
            )
        cpus = [int(node["CPU"]) for node in able]
        gpus = int(sum(node.get("GPU", 0) for node in able))
        if device == "cuda" and not gpus:
            ray.shutdown()
            raise InputError(
                "cluster-without-gpu",
                "--device cuda: no node of the cluster that has a CPU and memory has a GPU; use --device cpu, or auto",
            )
        self.threads = max(1, min(cores if jobs is None else sum(cpus) // jobs, *cpus))
        per_core = min(node["memory"] / node["CPU"] for node in able)
        self.memory_gb = per_core * self.threads / GB
        self.gpus = gpus if device != "cpu" else 0
        self.stopped = threading.Event()
        self._room = threading.Semaphore(jobs or MOST)
        self._remote = ray.remote(num_returns="streaming", max_retries=0)(_carry_out)

    def run(self, task: Task, begun: Callable[[str], None]) -> Ended:
        """Carry out a task as soon as a node has room.

        Args:
            task: What to run.
            begun: Told where, once it begins.
        """
        errors = self._ray.exceptions
        with self._room:
            if self.stopped.is_set():
                return Ended(STOPPED)
            remote = self._remote.options(
                num_cpus=task.threads, num_gpus=int(task.gpu), scheduling_strategy="SPREAD"
            )
            stream = remote.remote(task, devrf.__version__)
            try:
                begun(self._next(stream))
                return self._next(stream)
            except (errors.TaskCancelledError, StopIteration):  # what a cancelled task says last, Ray drops
                return Ended(STOPPED)
            except errors.RayTaskError as error:
                return Ended(FAILED, f"{task.path}: cannot be run there: {error.cause}")
            except errors.RayError as error:  # the node or its worker died, or Ray ended it to save memory
                return Ended(None, f"a node was lost ({type(error).__name__})")

    def close(self) -> None:
        """Leave the cluster, or end the one that was started here."""
        self._ray.shutdown()

    def _next(self, stream: Any) -> Any:
        """What a task says next; it is interrupted, once, where the batch has been told to stop."""
        while not self._ray.wait([stream], timeout=TICK_S)[0]:
            if self.stopped.is_set():
                self._ray.cancel(stream)
                self._ray.wait([stream.completed()])  # the stream has an end at once, its task has not
                raise StopIteration
        return self._ray.get(next(stream))


def _connected(address: str | None) -> Any:
    """The module `ray`, connected."""
    if address is not None and address != "auto":
        host, _, port = address.rpartition(":")
        try:  # Ray itself tries for minutes
            socket.create_connection((host.strip("[]"), int(port)), KNOCK_S).close()
        except (OSError, OverflowError, ValueError) as error:
            raise InputError(
                "cluster-unreachable",
                f"--address {address}: nothing answers there ({error}); expected HOST:PORT of the cluster's head (ray "
                f"start --head --port=PORT), or auto, or leave --address out",
            ) from None
    os.environ.update(SILENT if address else SILENT | LOOPBACK_ONLY)
    try:
        import ray
    except ImportError:
        text = "--engine ray: Ray is not installed; pip install 'devrf[ray]', or use --engine local"
        raise InputError("package-missing", text) from None
    import ray.exceptions

    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is None:
            ray.init(address="local", include_dashboard=False, num_cpus=usable_cores(), **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise InputError(
            "cluster-unreachable",
            f"--engine ray: no connection to {address or 'a cluster of its own'} ({error}); is ray of the same version "
            "there, and does `ray status` show its nodes?",
        ) from None
    return ray


def _carry_out(task: Task, version: str) -> Iterator[str | Ended]:
    """On a node: run a task. Ray cancels by an interrupt, which ends the run in order, as in the local pool."""
    import ray

    cancelled = threading.Event()
    before = signal.signal(signal.SIGINT, lambda number, frame: cancelled.set())
    try:
        yield f"{node_name()}/{ray.get_runtime_context().get_node_id()[:6]}"
        if version != devrf.__version__:
            message = (
                f"{node_name()} has devrf {devrf.__version__}, the batch {version}; install one everywhere"
            )
            yield Ended(FAILED, message)
        else:
            yield run_task(task, cancelled.is_set)
    finally:
        signal.signal(signal.SIGINT, before)
