"""The order of things in a batch: an engine that notes what it is asked for."""

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from devrf.pipelines.batch.board import Board
from devrf.pipelines.batch.groups import Group
from devrf.pipelines.batch.rows import SceneRow
from devrf.pipelines.batch.schedule import ATTEMPTS, Job, work_through
from devrf.pipelines.batch.task import Ended, Started, Task
from devrf.pipelines.console import Talk
from devrf.pipelines.exit_codes import DONE, FAILED


class Noting:
    """An engine that ends every task at once, with the next of its codes (None: the node was lost)."""

    threads, memory_gb, gpus, stopping = 1, 1.0, 0, False

    def __init__(self, *codes: int | None) -> None:
        self.codes, self.begun, self.happened = deque(codes), 0, []

    def submit(self, task: Task) -> None:
        self.begun += 1
        self.happened += [Started(task.scene, "here"), Ended(task.scene, self.codes.popleft())]

    def events(self, timeout_s: float) -> Sequence[Started | Ended]:
        found, self.happened = self.happened, []
        return found

    def stop(self) -> None: ...

    def close(self) -> None: ...


def job(scene: int, *groups: Group) -> Job:
    row = SceneRow(f"{scene}.yaml", str(scene), None)
    todo = deque(groups or (Group(("scene",), False),))
    return Job(scene, Path(f"{scene}.yaml"), Path("run"), (), row, todo, lambda: None)


def worked(jobs: list[Job], engine: Noting, out: Path) -> list[int | None]:
    rows = [job.row for job in jobs]
    with Board(Talk("quiet"), out, rows, "noting") as board:
        work_through(iter(jobs), engine, board)
    return [row.code for row in rows]


def test_what_happens_is_taken_in_while_the_next_scene_comes(tmp_path: Path) -> None:
    jobs = [job(n) for n in range(3)]
    seen: list[list[int | None]] = []

    def one_by_one() -> Iterator[Job]:
        for job in jobs:
            seen.append([other.row.code for other in jobs])
            yield job

    with Board(Talk("quiet"), tmp_path, [job.row for job in jobs], "noting") as board:
        work_through(one_by_one(), Noting(DONE, FAILED, DONE), board)
    assert seen == [[None, None, None], [DONE, None, None], [DONE, FAILED, None]]
    assert [job.row.code for job in jobs] == [DONE, FAILED, DONE]


def test_a_group_follows_the_one_before_unless_that_failed(tmp_path: Path) -> None:
    groups = (Group(("scene",), False), Group(("canonical",), True))
    engine = Noting(DONE, DONE)
    assert worked([job(0, *groups)], engine, tmp_path) == [DONE] and engine.begun == 2
    engine = Noting(FAILED)
    assert worked([job(0, *groups)], engine, tmp_path) == [FAILED] and engine.begun == 1


def test_a_task_that_loses_every_machine_is_given_up(tmp_path: Path) -> None:
    engine = Noting(*[None] * ATTEMPTS)
    lost = job(0)
    assert worked([lost], engine, tmp_path) == [FAILED]
    assert engine.begun == lost.row.lost == ATTEMPTS == 4
    engine = Noting(None, None, None, DONE)
    assert worked([job(0)], engine, tmp_path) == [DONE]
