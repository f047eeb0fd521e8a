"""The work of a batch: each scene's tasks one after the other, all scenes side by side, each in a thread that waits."""

import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace

from devrf.capture.errors import DevrfError
from devrf.pipelines.batch.board import Board
from devrf.pipelines.batch.groups import groups
from devrf.pipelines.batch.inputs import Inputs, inputs_of
from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.ray_cluster import RayCluster
from devrf.pipelines.batch.rows import SceneRow
from devrf.pipelines.batch.scenes import BatchScene, Options
from devrf.pipelines.batch.scratch import Stored
from devrf.pipelines.batch.store import Store
from devrf.pipelines.batch.task import Ended, Task
from devrf.pipelines.exit_codes import DONE, FAILED, STOPPED, code_of

TICK_S = 0.5  # between two looks at what runs
ATTEMPTS = 4  # of one task, three of them anew: whatever takes down so many nodes is the task
MOST_SCENES = 1000  # in work or waiting for room at once, each in a thread of its own


@dataclass
class Work:
    """What scenes are worked on with.

    Attributes:
        options: What each is run with.
        engine: Where.
        board: Where to say how it goes.
        look: Brings a scene's row up to date with what its stages left.
        store: Where raw files go that other machines are to see; None: they see the scenes' own paths.
        uploads: Held by the scene whose raw files are on their way.
    """

    options: Options
    engine: LocalPool | RayCluster
    board: Board
    look: Callable[[BatchScene, SceneRow], None]
    store: Store | None = None
    uploads: threading.Lock = field(default_factory=threading.Lock)

    def through(self, scenes: Sequence[BatchScene]) -> None:
        """Work on all scenes whose rows have not ended; the rows then say how each came out."""
        pairs = list(zip(scenes, self.board.rows, strict=True))
        with ThreadPoolExecutor(MOST_SCENES, "batch") as pool:
            waiting = {pool.submit(self._work, scene, row) for scene, row in pairs if row.code is None}
            try:
                while waiting:
                    _, waiting = wait(waiting, TICK_S)
                    self.board.write(now=False)
            finally:
                self.engine.stopped.set()

    def _work(self, scene: BatchScene, row: SceneRow) -> None:
        try:
            ended = self._ended(scene, row)
        except DevrfError as error:
            ended = Ended(code_of(error), str(error))
        except Exception as error:  # a thread has nobody to tell
            ended = Ended(FAILED, f"{scene.path}: cannot be run: {error}")
        row.end(FAILED if ended.code is None else ended.code, ended.message)
        self.board.ended(row)

    def _ended(self, scene: BatchScene, row: SceneRow) -> Ended:
        """Run a scene's tasks until one does not succeed."""
        with self.uploads:
            if self.engine.stopped.is_set():
                return Ended(STOPPED)
            task = self._task(scene)
        ended = Ended(DONE)
        assert scene.config is not None
        for stages, gpu in groups(scene.config, scene.standing, self.engine.gpus > 0):
            device = ("--device", "cuda" if gpu else "cpu")
            part = replace(task, stages=stages, gpu=gpu, arguments=(*task.arguments, *device))
            ended = self._carried_out(part, scene, row)
            if ended.code != DONE:
                break
            if ended.message:
                self.board.say(row, ended.message)
        return ended

    def _task(self, scene: BatchScene) -> Task:
        """What the tasks of a scene have in common; its raw files are in the store then.

        Raises:
            DevrfError: The store does not answer, or a file cannot be read.
        """
        config, run_dir = scene.config, scene.run_dir
        assert config is not None and run_dir is not None
        arguments, stored = self.options.arguments(), None
        if config.budget.memory_gb is None:  # runs side by side must not each count on all that is free
            arguments += ["--set", f"budget.memory_gb={self.engine.memory_gb:.3f}"]
        if self.store is not None:
            inputs = _put_inputs(self.store, scene)
            arguments += [word for text in inputs.overrides for word in ("--set", text)]
            stored = Stored(self.store.url, config.folder_name, scene.path.name, inputs.files)
        return Task(scene.path, run_dir, (), tuple(arguments), self.engine.threads, False, stored=stored)

    def _carried_out(self, task: Task, scene: BatchScene, row: SceneRow) -> Ended:
        """Run a task, and anew where its machine is lost."""
        ended = Ended(None)
        for attempt in range(1, ATTEMPTS + 1):
            ended = self._attempt(replace(task, attempt=attempt), scene, row)
            if ended.code is not None:
                return ended
            row.lost, row.state = row.lost + 1, "waiting"
            if attempt < ATTEMPTS:
                self.board.say(row, f"{ended.message}; begun anew elsewhere")
        what = f"{', '.join(task.stages)} lost {ATTEMPTS} machines ({ended.message}); look at their logs"
        return Ended(FAILED, what)

    def _attempt(self, task: Task, scene: BatchScene, row: SceneRow) -> Ended:
        start_s: list[float] = []

        def begun(node: str) -> None:
            start_s.append(time.monotonic())
            row.state = "running"
            row.nodes.append(node)
            self.board.say(row, f"{task.stages[0]} to {task.stages[-1]} on {node}")

        ended = self.engine.run(task, begun)
        if start_s:
            row.seconds = round(row.seconds + time.monotonic() - start_s[0], 3)
        try:
            self.look(scene, row)
        except DevrfError as error:  # a store that does not answer for a while
            self.board.say(row, str(error))
        return ended


def _put_inputs(store: Store, scene: BatchScene) -> Inputs:
    """Store a scene's raw files.

    Raises:
        DevrfError: The store does not answer, or a file cannot be read.
    """
    assert scene.config is not None and scene.digests is not None
    try:
        inputs = inputs_of(scene.config, scene.path, scene.digests)
        scene.digests.save()
        store.put_inputs(inputs.here)
    except OSError as error:  # one that has vanished since it was looked at
        text = f"{scene.path}: a raw file cannot be read ({error}); check its disk, then run the batch again"
        raise DevrfError("file-unreadable", text) from error
    return inputs
