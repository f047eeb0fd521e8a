"""The work of a batch: each scene's groups of stages one after the other, all scenes side by side."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.errors import DevrfError
from devrf.pipelines.batch.board import Board
from devrf.pipelines.batch.engine import Engine
from devrf.pipelines.batch.groups import Group
from devrf.pipelines.batch.rows import SceneRow
from devrf.pipelines.batch.scratch import Stored
from devrf.pipelines.batch.task import Ended, Started, Task
from devrf.pipelines.exit_codes import DONE, FAILED

TICK_S = 0.5  # between two looks at what runs
ATTEMPTS = 4  # of one task, three of them anew: whatever takes down so many nodes is the task


@dataclass
class Job:
    """A scene that has something to be done.

    Attributes:
        scene: Its number in the batch.
        path: Its scene.yaml.
        run_dir: Its run folder.
        arguments: Of `devrf-pipeline run`.
        row: Its row in the summary.
        todo: Groups of stages to come; the first is the one in work.
        look: Brings the row up to date with what the stages left.
        stored: Where the scene lies in a store.
        attempt: How often the group in work was begun.
    """

    scene: int
    path: Path
    run_dir: Path
    arguments: tuple[str, ...]
    row: SceneRow
    todo: deque[Group]
    look: Callable[[], None]
    stored: Stored | None = None
    attempt: int = 1

    def task(self, threads: int) -> Task:
        """What to run next."""
        group = self.todo[0]
        return Task(
            self.scene,
            self.path,
            self.run_dir,
            group.stages,
            (*self.arguments, "--device", "cuda" if group.gpu else "cpu"),
            threads,
            group.gpu,
            self.attempt,
            self.stored,
        )


def work_through(jobs: Iterable[Job], engine: Engine, board: Board) -> None:
    """Run all jobs to their ends; the rows say how each came out. One that fails stops no other.

    To get the next job can take long (its raw files go to the store): what has happened meanwhile is taken in between.
    """
    open_jobs: dict[int, Job] = {}
    for job in jobs:
        open_jobs[job.scene] = job
        engine.submit(job.task(engine.threads))
        _take_events(open_jobs, engine, board, 0.0)
    while open_jobs:
        _take_events(open_jobs, engine, board, TICK_S)


def _take_events(open_jobs: dict[int, Job], engine: Engine, board: Board, timeout_s: float) -> None:
    for event in engine.events(timeout_s):
        job = open_jobs[event.scene]
        if isinstance(event, Started):
            job.row.state = "running"
            job.row.nodes.append(event.node)
            board.say(job.row, f"{job.todo[0].stages[0]} to {job.todo[0].stages[-1]} on {event.node}")
        elif _goes_on(job, event, board):
            engine.submit(job.task(engine.threads))
        else:
            del open_jobs[event.scene]
            board.ended(job.row)
    board.show()


def _goes_on(job: Job, ended: Ended, board: Board) -> bool:
    """Take the end of a task; whether there is another to run."""
    job.row.seconds = round(job.row.seconds + ended.seconds, 3)
    try:
        job.look()
    except DevrfError as error:  # a store that does not answer for a while
        board.say(job.row, str(error))
    if ended.code is None:
        job.row.lost += 1
        if job.attempt >= ATTEMPTS:
            what = f"{', '.join(job.todo[0].stages)} lost {job.attempt} machines ({ended.message}); look at their logs"
            job.row.end(FAILED, what)
            return False
        board.say(job.row, f"{ended.message}; begun anew elsewhere")
        job.attempt += 1
        job.row.state = "waiting"
        return True
    job.attempt = 1
    job.todo.popleft()
    if ended.code == DONE and ended.message:
        board.say(job.row, ended.message)
    if ended.code != DONE or not job.todo:
        job.row.end(ended.code, ended.message)
        return False
    return True
