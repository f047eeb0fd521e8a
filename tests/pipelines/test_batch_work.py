"""The order of things in a batch, its shares of cores and GPUs, its summary; tasks end as they are told."""

import io
import json
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from rich.console import Console
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.pipelines.batch import local
from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.progress_table import Board
from devrf.pipelines.batch.scene_rows import SceneRow, exit_code
from devrf.pipelines.batch.scenes import BatchOptions, look, stand
from devrf.pipelines.batch.task import Ended, Task
from devrf.pipelines.batch.work import ATTEMPTS, Work
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED

Run = Callable[[Task, Callable[[], bool], int | None], Ended]


def rows_with(*codes: int | None) -> list[SceneRow]:
    found = []
    for n, code in enumerate(codes):
        row = SceneRow(f"/{n}/scene.yaml", f"scene{n}", f"/{n}/run")
        if code is not None:
            row.end(code, "it is broken" if code else None)
        found.append(row)
    return found


@pytest.mark.parametrize(
    ("codes", "expected"),
    [
        ((0, 0), 0),
        ((0, 2), 2),
        ((2, 3, 0), 3),
        ((3, 1, 2), 1),
        ((1, 130, 3), 130),
        ((0, 137), 1),
        ((-9, 3), 1),
        ((), 0),
    ],
)
def test_the_worst_code_speaks_for_the_batch(codes: tuple[int, ...], expected: int) -> None:
    assert exit_code(rows_with(*codes)) == expected


def test_on_a_terminal_what_runs_is_shown(tmp_path: Path) -> None:
    talk, screen = Talk("normal"), io.StringIO()
    talk.out = Console(file=screen, force_terminal=True, width=120)
    rows = rows_with(None, None, 0)
    rows[0].state, rows[0].made = "running", ["ingest", "sync"]
    with Board(talk, tmp_path, rows, "local").live():
        pass
    shown = screen.getvalue()
    assert "scene0" in shown and "ingest, sync" in shown and "1 waiting" in shown


def test_the_file_follows_the_rows_and_stops_nothing_where_it_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, rows = tmp_path / "out", rows_with(None, 1)
    out.mkdir()
    board = Board(Talk("quiet"), out, rows, "ray")
    board.write()
    batch = json.loads((out / "batch.json").read_text())
    assert not batch["finished"] and batch["states"] == {"waiting": 1, "failed": 1}
    rows[0].end(0)
    board.write(now=False)  # not so soon
    assert json.loads((out / "batch.json").read_text()) == batch
    board.write()
    batch = json.loads((out / "batch.json").read_text())
    assert batch["finished"] and batch["code"] == 1 and [row["code"] for row in batch["scenes"]] == [0, 1]
    assert [path.name for path in out.iterdir()] == ["batch.json"]
    shutil.rmtree(out)
    board.write()
    board.write()
    assert not board.written and capsys.readouterr().err.count("[folder-unwritable]") == 1


def worked(
    folder: Path, monkeypatch: pytest.MonkeyPatch, run: Run, pool: LocalPool, names: Sequence[str]
) -> list[SceneRow]:
    """Rows of scenes whose tasks end as `run` says."""
    monkeypatch.setattr(local, "run_task", run)
    scenes = look([tiny_scene(folder, name) for name in names], BatchOptions())
    for scene in scenes:
        stand(scene)
    rows = [SceneRow(str(scene.path), scene.name, None) for scene in scenes]
    board = Board(Talk("quiet"), folder, rows, "local")
    Work(BatchOptions(), pool, board).through(scenes)
    return rows


@pytest.mark.parametrize(
    ("gpus", "codes", "expected", "lost"),
    [
        (0, [DONE], DONE, 0),
        (1, [DONE], DONE, 0),
        (0, [FAILED], FAILED, 0),
        (0, [None, None, None, DONE], DONE, 3),
        (0, [None] * ATTEMPTS, FAILED, 4),
    ],
)
def test_a_task_is_begun_anew_where_a_machine_is_lost(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    gpus: int,
    codes: list[int | None],
    expected: int,
    lost: int,
) -> None:
    left, begun = deque(codes), []

    def run(task: Task, stop: object, gpu: int | None) -> Ended:
        assert (task.gpu, gpu) == ((True, 0) if gpus else (False, None))
        begun.append((task.attempt, task.stages[0]))
        return Ended(left.popleft(), "as it is told")

    (row,) = worked(tmp_path, monkeypatch, run, LocalPool(1, 1, 1.0, gpus), ["a"])
    assert (row.code, row.lost, len(left)) == (expected, lost, 0)
    assert begun == [(attempt, "scene") for attempt in range(1, len(codes) + 1)]


@pytest.mark.parametrize(("gpus", "at_once", "places"), [(0, 3, {None}), (2, 2, {0, 1})])
def test_tasks_share_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gpus: int, at_once: int, places: set[int | None]
) -> None:
    running, most, used, lock = 0, 0, set(), threading.Lock()

    def run(task: Task, stop: object, gpu: int | None) -> Ended:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
            used.add(gpu)
        time.sleep(0.05)
        with lock:
            running -= 1
        if task.path.parent.name == "s7":
            raise OSError("no more processes")
        return Ended(DONE)

    names = [f"s{n}" for n in range(12)]
    rows = worked(tmp_path, monkeypatch, run, LocalPool(3, 1, 1.0, gpus), names)
    assert {row.name: row.code for row in rows if row.code != DONE} == {"s7": FAILED}
    assert most == at_once and used == places


def test_stopped_it_begins_nothing_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pool, begun = LocalPool(1, 1, 1.0, 0), []

    def run(task: Task, stop: Callable[[], bool], gpu: int | None) -> Ended:
        begun.append(task.path)
        pool.stopped.set()
        return Ended(STOPPED if stop() else DONE)

    rows = worked(tmp_path, monkeypatch, run, pool, ["a", "b", "c"])
    assert [row.state for row in rows] == ["stopped"] * 3 and [path.parent.name for path in begun] == ["a"]


def test_scenes_begin_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[str] = []

    def run(task: Task, stop: object, gpu: int | None) -> Ended:
        begun.append(task.path.parent.name)
        return Ended(DONE)

    names = [f"s{n}" for n in range(20)]
    worked(tmp_path, monkeypatch, run, LocalPool(1, 1, 1.0, 0), names)
    assert begun == names
