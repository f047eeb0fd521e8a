"""Tasks on a Ray cluster: CPUs and GPUs are its resources, and what a lost node was doing is handed back as lost.

Ray is asked for no retries of its own: a task begun anew has to wait for the run that the lost node may have left
behind, and the summary is to say what was lost.
"""

import os
import signal
import socket
import threading
from collections.abc import Callable
from typing import Any

import devrf
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import InputError
from devrf.pipelines.batch.task import Ended, Task, node_name, run_task
from devrf.pipelines.budget.memory import GB
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, FAILED, STOPPED
from devrf.pipelines.terminal.signals import handled

# what makes Ray listen on 127.0.0.1 alone, on Linux too
LOOPBACK_ONLY = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
SILENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # nothing is sent to Ray's makers
    "RAY_DEDUP_LOGS_SKIP_REGEX": "^",  # a lost node would print pages; what it means is said by the batch
}
TICK_S = 1.0  # between two looks at whether to stop; a thousand threads look
KNOCK_S = 5.0  # a head that does not take a connection within this time is not there
MOST_SCENES = 1000  # whose tasks wait for room in the cluster at once, each in a thread of its own


class RayCluster:
    """A Ray cluster; each of its tasks is waited for by the thread that asks for it.

    Args:
        address: HOST:PORT of the cluster, or auto; None starts one on this machine, which only this machine reaches.
        jobs: Tasks at once, which share all cores; None: as many as there is room for.
        cores: Cores of a task where neither `jobs` nor the number of GPUs says; fewer where a node has fewer.
        device: auto, cpu or cuda.
    Attributes:
        at_once: Tasks that can run or wait for room at once: so many threads wait for one.
        threads, memory_gb: Cores and main memory that each task gets.
        gpus: GPUs there are; each task gets one where there are any.
        stopped: Set, nothing more is begun, and what runs is ended in order.
    Raises:
        InputError: Ray is not installed, the cluster is not there, or it has no GPU where one is wished for.
    """

    def __init__(self, address: str | None, jobs: int | None, cores: int, device: str) -> None:
        self._ray = ray = _connected(address)
        self.at_once = MOST_SCENES
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        able = [node for node in nodes if node.get("CPU", 0) >= 1 and node.get("memory")]
        if not able:
            ray.shutdown()
            raise InputError(
                "cluster-without-memory",
                f"--address {address}: no node of the cluster has a CPU and memory; start nodes with --num-cpus and "
                "--memory",
            )
        with_gpus = [node for node in able if node.get("GPU", 0) >= 1] if device != "cpu" else []
        if device == "cuda" and not with_gpus:
            ray.shutdown()
            raise InputError(
                "cluster-without-gpu",
                "--device cuda: no node of the cluster that has a CPU and memory has a GPU; use --device cpu, or auto",
            )
        able = with_gpus or able
        cpus = [int(node["CPU"]) for node in able]
        self.gpus = int(sum(node["GPU"] for node in with_gpus))
        wished = sum(cpus) // (jobs or self.gpus) if jobs or self.gpus else cores
        self.threads = max(1, min(wished, *cpus))
        self.memory_gb = min(node["memory"] / node["CPU"] for node in able) * self.threads / GB
        self.stopped = threading.Event()
        room = self.gpus or sum(count // self.threads for count in cpus)
        self._room = threading.Semaphore(min(jobs or room, room))
        self._remote = ray.remote(max_retries=0)(_carry_out)

    def run(self, task: Task, begun: Callable[[], None]) -> Ended:
        """Carry out a task as soon as a node has room.

        Args:
            task: What to run.
            begun: Told once it begins.
        """
        ray = self._ray
        with self._room:
            if self.stopped.is_set():
                return Ended(STOPPED)
            begun()
            future = self._remote.options(
                num_cpus=task.threads, num_gpus=int(task.gpu), scheduling_strategy="SPREAD"
            ).remote(task, devrf.__version__)
            told = False
            while not ray.wait([future], timeout=TICK_S)[0]:
                if self.stopped.is_set() and not told:
                    ray.cancel(future)
                    told = True
            try:
                return ray.get(future)
            except ray.exceptions.TaskCancelledError:
                return Ended(STOPPED)
            except ray.exceptions.RayTaskError as error:
                return Ended(FAILED, f"{task.path}: cannot be run there: {error.cause}")
            except (
                ray.exceptions.RayError
            ) as error:  # the node or its worker died, or Ray ended it to save memory
                return Ended(None, f"a node was lost ({type(error).__name__})")

    def close(self) -> None:
        """Leave the cluster, or end the one that was started here."""
        self._ray.shutdown()


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


def _carry_out(task: Task, version: str) -> Ended:
    """On a node: run a task. Ray cancels by an interrupt, which ends the run in order, as in the local pool."""
    cancelled = threading.Event()
    with handled(lambda number, frame: cancelled.set(), signal.SIGINT):
        if version != devrf.__version__:
            text = f"{node_name()} has devrf {devrf.__version__}, the batch {version}; install one everywhere"
            return Ended(FAILED, text, node_name())
        if not (task.path.is_file() and task.run_dir.is_dir()):
            text = (
                f"{task.path}: {node_name()} does not see it, or not its output {task.run_dir}; scenes and their "
                "outputs must lie on a disk that all machines share or mount under the same path"
            )
            return Ended(BAD_INPUT, text, node_name())
        return run_task(task, cancelled.is_set)
