"""The work of a batch: all scenes side by side, each in a thread that waits for its task."""

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace

from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.progress_table import Board
from devrf.pipelines.batch.ray_cluster import RayCluster
from devrf.pipelines.batch.scene_rows import SceneRow
from devrf.pipelines.batch.scenes import BatchOptions, BatchScene
from devrf.pipelines.batch.task import Ended, Task
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.terminal.exit_codes import FAILED

TICK_S = 0.5  # between two looks at what runs
ATTEMPTS = 4  # of one task, three of them anew: whatever takes down so many nodes is the task


@dataclass
class Work:
    """What scenes are worked on with.

    Attributes:
        options: What each is run with.
        engine: Where.
        board: Where to say how it goes.
    """

    options: BatchOptions
    engine: LocalPool | RayCluster
    board: Board

    def through(self, scenes: Sequence[BatchScene]) -> None:
        """Work on all scenes whose rows have not ended; the rows then say how each came out."""
        pairs = list(zip(scenes, self.board.rows, strict=True))
        with ThreadPoolExecutor(self.engine.at_once, "batch") as pool:  # they begin in their order
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
        except Exception as error:  # a thread has nobody to tell
            ended = Ended(FAILED, f"{scene.path}: cannot be run: {error}")
        row.end(FAILED if ended.code is None else ended.code, ended.message)
        self.board.ended(row)

    def _ended(self, scene: BatchScene, row: SceneRow) -> Ended:
        """Run a scene, and anew where its machine is lost."""
        assert scene.run is not None
        task, ended = self._task(scene, scene.run), Ended(None)
        for attempt in range(1, ATTEMPTS + 1):
            ended = self._attempt(replace(task, attempt=attempt), row)
            row.look(task.run_dir, scene.stages)
            if ended.code is not None:
                return ended
            row.lost, row.state = row.lost + 1, "waiting"
            if attempt < ATTEMPTS:
                self.board.say(row, f"{ended.message}; begun anew elsewhere")
        return Ended(FAILED, f"lost {ATTEMPTS} machines ({ended.message}); look at their logs")

    def _task(self, scene: BatchScene, run: Run) -> Task:
        gpu = self.engine.gpus > 0
        arguments = [*self.options.arguments(), "--device", "cuda" if gpu else "cpu"]
        if run.config.budget.memory_gb is None:  # runs side by side must not each count on all that is free
            arguments += ["--set", f"budget.memory_gb={self.engine.memory_gb:.3f}"]
        return Task(scene.path, run.run_dir, tuple(scene.to_do), tuple(arguments), self.engine.threads, gpu)

    def _attempt(self, task: Task, row: SceneRow) -> Ended:
        start_s: list[float] = []

        def begun() -> None:
            start_s.append(time.monotonic())
            row.state = "running"
            self.board.say(row, f"{task.stages[0]} to {task.stages[-1]}")

        ended = self.engine.run(task, begun)
        if start_s:
            row.seconds = round(row.seconds + time.monotonic() - start_s[0], 3)
        if ended.node is not None:
            row.nodes.append(ended.node)
        return ended
