"""`devrf-pipeline batch`: check all scenes, run what is missing, keep a summary."""

import signal
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from devrf.capture.system.cores import usable_cores
from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.writable import check_folder
from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.progress_table import JSON_FILE, Board
from devrf.pipelines.batch.ray_cluster import RayCluster
from devrf.pipelines.batch.scene_rows import SceneRow, exit_code
from devrf.pipelines.batch.scenes import BatchOptions, BatchScene, look, stand
from devrf.pipelines.batch.task import GRACE_S
from devrf.pipelines.batch.work import Work
from devrf.pipelines.budget.memory import GB, RESERVE, left_bytes
from devrf.pipelines.config.words import unknown_word
from devrf.pipelines.inputs.device import check_device, resolve_device
from devrf.pipelines.runner.supervise import tell
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, UNHEALTHY, code_of
from devrf.pipelines.terminal.signals import handled

ENGINES = ("local", "ray")
CORES_PER_JOB = 2  # structure from motion keeps one core busy, training all that it gets
GB_PER_JOB = 4.0  # what the example takes at most is 2.3 GB (docs/results.md)
STOP_S = int(GRACE_S) + 30  # to end in order: what the runs get, and time to say so


def batch(talk: Talk, paths: Sequence[Path], options: BatchOptions) -> int:
    """Run the scenes.

    Args:
        talk: Where to speak.
        paths: scene.yaml files, or folders that hold one.
        options: What each is run with, and where.
    Returns:
        The exit code.
    Raises:
        InputError: The batch as a whole cannot be run.
    """
    engine, out = options.engine, options.out
    if engine not in ENGINES:
        raise unknown_word("--engine", engine, ENGINES)
    check_device(options.device)
    if engine == "local" and options.device == "cuda":
        resolve_device("cuda")  # before the scenes are looked at, which can take minutes
    if options.address is not None and engine != "ray":
        raise InputError("option-misplaced", "--address: is for --engine ray; add that, or leave it out")
    check_folder(out, "--out")
    with disk_told(f"--out {out}", "choose another folder", InputError):
        out.mkdir(parents=True, exist_ok=True)
    scenes = look(paths, options)
    rows = [_row(scene, options) for scene in scenes]
    board = Board(talk, out, rows, engine)
    with ExitStack() as stack:
        workers = _workers(options, stack) if any(row.code is None for row in rows) else None
        stack.callback(board.write)
        for row in rows:
            if row.code is not None:
                board.ended(row)
        if workers is not None:
            stack.enter_context(board.live())
            # Ctrl-C and TERM end what runs, in order; nothing more is begun.
            stop = handled(lambda number, frame: workers.stopped.set(), signal.SIGINT, signal.SIGTERM)
            stack.enter_context(stop)
            tell(grace_s=STOP_S)
            Work(options, workers, board).through(scenes)
    done = sum(row.code == DONE for row in rows)
    talk.say(f"{done} of {len(rows)} scenes done{f'; {out / JSON_FILE}' if board.written else ''}")
    return exit_code(rows) or (DONE if board.written else FAILED)


def _row(scene: BatchScene, options: BatchOptions) -> SceneRow:
    """A scene's row, ended already where there is nothing to run."""
    row = SceneRow(str(scene.path), scene.name, None if scene.run_dir is None else str(scene.run_dir))
    if scene.run_dir is not None and scene.problem is None:
        try:
            stand(scene)
            row.look(scene.run_dir, scene.stages)
        except DevrfError as error:
            row.end(code_of(error), str(error))
            return row
    if scene.problem is not None:
        row.end(BAD_INPUT, scene.problem)
    elif not scene.to_do:
        refused = row.verdict == "fail" and not options.allow_unhealthy
        row.end(
            UNHEALTHY if refused else DONE,
            "its own checks refused the result; see its report" if refused else None,
        )
    return row


def _workers(options: BatchOptions, stack: ExitStack) -> LocalPool | RayCluster:
    """What the tasks run on; given back when the stack is left.

    Raises:
        InputError: It is not there.
    """
    if options.engine == "local":
        return _local(options)
    cluster = RayCluster(options.address, options.jobs, CORES_PER_JOB, options.device)
    stack.callback(cluster.close)
    return cluster


def _local(options: BatchOptions) -> LocalPool:
    cores, gpus = usable_cores(), 0
    if resolve_device(options.device) == "cuda":
        import torch

        gpus = torch.cuda.device_count()
    memory_gb = left_bytes() * (1 - RESERVE) / GB
    jobs = options.jobs or gpus or max(1, min(cores // CORES_PER_JOB, int(memory_gb / GB_PER_JOB)))
    jobs = min(jobs, gpus or jobs)
    return LocalPool(jobs, max(1, cores // jobs), memory_gb / jobs, gpus)
