"""`devrf-pipeline batch`: check all scenes, run what is missing, keep a summary."""

import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from devrf.capture.cores import usable_cores
from devrf.capture.errors import DevrfError, InputError
from devrf.capture.writable import check_folder
from devrf.pipelines.batch.board import HTML_FILE, Board
from devrf.pipelines.batch.engine import Engine
from devrf.pipelines.batch.groups import groups
from devrf.pipelines.batch.inputs import Inputs, inputs_of
from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.mirror import mirror
from devrf.pipelines.batch.ray_cluster import RayCluster
from devrf.pipelines.batch.rows import SceneRow, exit_code
from devrf.pipelines.batch.scenes import BatchScene, Options, look, stand
from devrf.pipelines.batch.schedule import Job, work_through
from devrf.pipelines.batch.scratch import Stored
from devrf.pipelines.batch.store import Store
from devrf.pipelines.batch.task import GRACE_S
from devrf.pipelines.budget.memory import GB, RESERVE, left_bytes
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.console import Talk
from devrf.pipelines.device import check_device, resolve_device
from devrf.pipelines.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED, UNHEALTHY, code_of
from devrf.pipelines.runner.supervise import tell
from devrf.pipelines.stamps.digests import Digests

CORES_PER_JOB = 2  # structure from motion keeps one core busy, training all that it gets
GB_PER_JOB = 4.0  # what the example takes at most is 2.3 GB (docs/results.md)
STOP_S = int(GRACE_S) + 30  # to end in order: what the runs get, and time to store what they finished


@dataclass(frozen=True)
class Machines:
    """Where a batch runs.

    Attributes:
        engine: local or ray.
        address: Of a Ray cluster; None starts one on this machine.
        jobs: Scenes at once; None: as there is room.
        device: auto, cpu or cuda.
    """

    engine: str = "local"
    address: str | None = None
    jobs: int | None = None
    device: str = "auto"


def batch(
    talk: Talk, paths: Sequence[Path], options: Options, machines: Machines, out: Path, store: str | None
) -> int:
    """Run the scenes.

    Args:
        talk: Where to speak.
        paths: scene.yaml files, or folders that hold one.
        options: What each is run with.
        machines: Where.
        out: Folder of the summary.
        store: URL of a store that all machines reach; None: they all see the scenes' own paths.
    Returns:
        The exit code.
    Raises:
        InputError: The batch as a whole cannot be run.
    """
    if machines.engine not in ("local", "ray"):
        raise InputError(f"--engine {machines.engine}: expected local or ray")
    check_device(machines.device)
    if machines.engine == "local" and machines.device == "cuda":
        resolve_device("cuda")  # before the scenes are looked at, which can take minutes
    if machines.address is not None and machines.engine != "ray":
        raise InputError("--address: is for --engine ray; add that, or leave it out")
    check_folder(out, "--out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"--out {out}: cannot be made ({error.strerror or error}); choose another folder"
        ) from None
    place = _Place(out, None if store is None else Store(store), talk.say)
    if place.store is not None:
        place.store.check()
    scenes = look(paths, options, unique_names=store is not None)
    rows = [_row(scene, options, place) for scene in scenes]
    with ExitStack() as stack:
        engine = None
        if any(row.code is None for row in rows):
            engine = stack.enter_context(_engine(machines))
        board = stack.enter_context(Board(talk, out, rows, machines.engine))
        for row in rows:
            if row.code is not None:
                board.ended(row)
        if engine is not None:
            stack.enter_context(_stopped_by_signals(engine))
            tell(grace_s=STOP_S)
            work_through(_jobs(scenes, rows, options, engine, place, board), engine, board)
    done = sum(row.code == DONE for row in rows)
    talk.say(f"{done} of {len(rows)} scenes done{f'; {out / HTML_FILE}' if board.written else ''}")
    return exit_code(rows) or (DONE if board.written else FAILED)


@dataclass(frozen=True)
class _Place:
    """Where the stages of scenes are seen: in their run folders, or in mirrors of a store."""

    out: Path
    store: Store | None
    say: Callable[[str], None]

    def refresh(self, config: SceneConfig, scene_dir: Path) -> Path:
        """A folder with the stamps of a scene's stages, brought up to date.

        Raises:
            DevrfError: The store does not answer, or the folder cannot be written.
        """
        if self.store is None:
            return config.run_dir(scene_dir)
        folder = (self.out / "scenes" / config.folder_name).resolve()
        try:
            mirror(self.store, config, scene_dir, folder, self.say)
        except OSError as error:
            raise DevrfError(
                f"{folder}: cannot be written ({error.strerror or error}); make room there"
            ) from None
        return folder


def _row(scene: BatchScene, options: Options, place: _Place) -> SceneRow:
    """A scene's row, ended already where there is nothing to run."""
    row = SceneRow(str(scene.path), scene.name, None if scene.run_dir is None else str(scene.run_dir))
    if scene.config is not None and scene.problem is None:
        try:
            seen_in = place.refresh(scene.config, scene.scene_dir)
            stand(scene, options, seen_in)
            row.look(seen_in, scene.stages)
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


def _jobs(
    scenes: Sequence[BatchScene],
    rows: Sequence[SceneRow],
    options: Options,
    engine: Engine,
    place: _Place,
    board: Board,
) -> Iterator[Job]:
    """What is to be run, one by one: the first runs while the raw files of the next are on their way to the store."""
    for number, (scene, row) in enumerate(zip(scenes, rows, strict=True)):
        config, scene_dir, run_dir = scene.config, scene.scene_dir, scene.run_dir
        if row.code is not None or config is None or run_dir is None or scene.digests is None:
            continue
        if engine.stopping:
            row.end(STOPPED)
            board.ended(row)
            continue
        arguments, stored = options.arguments(), None
        if config.budget.memory_gb is None:  # runs side by side must not each count on all that is free
            arguments += ["--set", f"budget.memory_gb={engine.memory_gb:.3f}"]
        if place.store is not None:
            try:
                inputs = _put_inputs(place.store, config, scene.path, scene.digests)
            except DevrfError as error:
                row.end(code_of(error), str(error))
                board.ended(row)
                continue
            arguments += [word for text in inputs.overrides for word in ("--set", text)]
            stored = Stored(place.store.url, config.folder_name, scene.path.name, inputs.files)
        todo = deque(groups(config, scene.standing, engine.gpus > 0))
        look = partial(_look, row, config, scene_dir, scene.stages, place)
        yield Job(number, scene.path, run_dir, tuple(arguments), row, todo, look, stored)


def _look(row: SceneRow, config: SceneConfig, scene_dir: Path, stages: list[str], place: _Place) -> None:
    row.look(place.refresh(config, scene_dir), stages)


def _put_inputs(store: Store, config: SceneConfig, scene: Path, digests: Digests) -> Inputs:
    """Store a scene's raw files.

    Raises:
        DevrfError: The store does not answer, or a file cannot be read.
    """
    try:
        inputs = inputs_of(config, scene, digests)
        digests.save()
        store.put_inputs(inputs.here)
    except OSError as error:  # one that has vanished since it was looked at
        raise DevrfError(
            f"{scene}: a raw file cannot be read ({error}); check its disk, then run the batch again"
        ) from error
    return inputs


@contextmanager
def _engine(machines: Machines) -> Iterator[Engine]:
    """What the tasks run on; given back in the end.

    Raises:
        InputError: It is not there.
    """
    if machines.engine == "ray":
        engine: Engine = RayCluster(machines.address, machines.jobs, CORES_PER_JOB, machines.device)
    else:
        engine = _local(machines)
    try:
        yield engine
    finally:
        engine.close()


def _local(machines: Machines) -> LocalPool:
    cores, gpus = usable_cores(), 0
    if resolve_device(machines.device) == "cuda":
        import torch

        gpus = torch.cuda.device_count()
    memory_gb = left_bytes() * (1 - RESERVE) / GB
    jobs = machines.jobs or max(1, min(cores // CORES_PER_JOB, int(memory_gb / GB_PER_JOB) - gpus))
    return LocalPool(jobs, max(1, cores // (jobs + gpus)), memory_gb / (jobs + gpus), gpus)


@contextmanager
def _stopped_by_signals(engine: Engine) -> Iterator[None]:
    """Ctrl-C and TERM end what runs, in order; nothing more is begun."""
    handled = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda number, frame: engine.stop()) for number in handled}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
