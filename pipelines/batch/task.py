"""One piece of work of a batch: the stages of one scene that are to be made, run in a process of its own."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.processes import run_module
from devrf.pipelines.run_folder.lock import Lock
from devrf.pipelines.run_folder.outcomes import error_path, last_error
from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED, code_of

POLL_S = 0.1  # between two looks at whether to stop
GRACE_S = 60.0  # from TERM to KILL; longer than a run's own processes get from it
LOCK_WAIT_S = 90.0  # for a run that a dead node left: it has been told to stop, and gets its grace
MESSAGE_CHARACTERS = 4000
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class Task:
    """What to run.

    Attributes:
        path: The scene's scene.yaml.
        run_dir: Its run folder.
        stages: Names of the stages, in order.
        arguments: Of `devrf-pipeline run`, besides the scene and the stages.
        threads: Cores to use.
        gpu: Whether to have a GPU.
        attempt: 1, or more where a node was lost on the way.
    """

    path: Path
    run_dir: Path
    stages: tuple[str, ...]
    arguments: tuple[str, ...]
    threads: int
    gpu: bool
    attempt: int = 1


@dataclass(frozen=True)
class Ended:
    """A task has come to its end.

    Attributes:
        code: Exit code of the run; None where the node was lost.
        message: What went wrong. Of one that is done or was stopped there is none.
        node: Machine that it ran on, where that is known.
    """

    code: int | None
    message: str | None = None
    node: str | None = None


def run_task(task: Task, stop: Callable[[], bool] = lambda: False, gpu: int | None = None) -> Ended:
    """Run a task to its end.

    Args:
        task: What to run.
        stop: Asked now and then; True ends the run as Ctrl-C does.
        gpu: Which of the GPUs that this process sees, where the scheduler has not set it already.
    """
    try:
        if task.attempt > 1:
            _wait_for_lock(task.run_dir, stop)
        return _run(task, stop, gpu)
    except DevrfError as error:
        return Ended(code_of(error), str(error), node_name())
    except OSError as error:
        return Ended(FAILED, f"{task.path}: cannot be run on {node_name()}: {error}", node_name())


def _run(task: Task, stop: Callable[[], bool], gpu: int | None) -> Ended:
    if stop():
        return Ended(STOPPED)
    started_s = time.time()
    process = subprocess.Popen(
        run_module("devrf.pipelines.batch.child", str(os.getpid()), *_command(task)),
        env=_environment(task, gpu),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,  # Ctrl-C in a terminal comes from the batch, once
    )
    try:
        said, stopped = _wait(process, stop)
    except BaseException:  # nobody would wait for it any more
        _end(process)
        raise
    code = process.returncode
    if stopped and code < 0:  # before it could listen, or because it did not
        code = STOPPED
    message = None if code in (DONE, STOPPED) else _message(task, started_s, code, said)
    return Ended(code if code >= 0 else FAILED, message, node_name())


def node_name() -> str:
    """What this machine is called in a summary."""
    return socket.gethostname()


def _command(task: Task) -> list[str]:
    stages = ["--from", task.stages[0], "--until", task.stages[-1]]
    return ["run", str(task.path), *stages, *task.arguments, "--quiet"]


def _environment(task: Task, gpu: int | None) -> dict[str, str]:
    """Threads for its share of the cores."""
    threads = str(task.threads)
    ours = {"OMP_NUM_THREADS": threads, "OPENCV_FOR_THREADS_NUM": threads}
    if gpu is not None:
        seen = os.environ.get(VISIBLE_GPUS)
        ours[VISIBLE_GPUS] = seen.split(",")[gpu].strip() if seen else str(gpu)
    return {**os.environ, **ours}


def _wait(process: subprocess.Popen, stop: Callable[[], bool]) -> tuple[str, bool]:
    """Wait for the end; what it said on stderr, and whether it was told to stop."""
    while True:
        try:
            return process.communicate(timeout=POLL_S)[1], False
        except subprocess.TimeoutExpired:
            if stop():
                return _end(process), True


def _end(process: subprocess.Popen) -> str:
    """TERM, grace, KILL."""
    process.terminate()
    try:
        return process.communicate(timeout=GRACE_S)[1]
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        return process.communicate()[1]


def _message(task: Task, started_s: float, code: int, said: str) -> str:
    """Why a run failed: what it left beside the stage, else what it said."""
    for stage in task.stages:
        path = error_path(task.run_dir, stage)
        if path.is_file() and path.stat().st_mtime >= started_s and (text := last_error(task.run_dir, stage)):
            return text
    if code < 0:
        return f"{task.path}: the run was killed by {signal.Signals(-code).name}; see devrf.log in {task.run_dir}"
    return said.strip()[-MESSAGE_CHARACTERS:] or f"exit code {code}; see devrf.log in {task.run_dir}"


def _wait_for_lock(run_dir: Path, stop: Callable[[], bool]) -> None:
    """Give a run that a lost node left behind the time to let go. What holds it then is `run`'s to judge."""
    deadline = time.monotonic() + LOCK_WAIT_S
    while run_dir.is_dir() and time.monotonic() < deadline and not stop():
        lock = Lock(run_dir)
        try:
            lock.take()
        except InputError:
            time.sleep(POLL_S)
        else:
            lock.release()
            return
