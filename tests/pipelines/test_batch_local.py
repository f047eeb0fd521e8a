"""The local pool alone: how many tasks at once, and one at a time on each GPU."""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from devrf.pipelines.batch import local
from devrf.pipelines.batch.local import LocalPool
from devrf.pipelines.batch.task import Ended, Task
from devrf.pipelines.exit_codes import DONE, FAILED, STOPPED


def task(scene: int, gpu: bool) -> Task:
    return Task(scene, Path("scene.yaml"), Path("run"), ("canonical",), (), 1, gpu)


def ends(pool: LocalPool, count: int) -> list[Ended]:
    found: list[Ended] = []
    deadline = time.monotonic() + 30
    while len(found) < count and time.monotonic() < deadline:
        found += [event for event in pool.events(0.1) if isinstance(event, Ended)]
    return found


def test_tasks_share_cores_and_gpus(monkeypatch: pytest.MonkeyPatch) -> None:
    running: dict[bool, int] = {True: 0, False: 0}
    most, used, lock = {True: 0, False: 0}, set(), threading.Lock()

    def work(task: Task, stop: object, gpu: int | None) -> Ended:
        with lock:
            running[task.gpu] += 1
            most[task.gpu] = max(most[task.gpu], running[task.gpu])
            used.add(gpu)
        time.sleep(0.05)
        with lock:
            running[task.gpu] -= 1
        if task.scene == 7:
            raise OSError("no more processes")
        return Ended(task.scene, DONE)

    monkeypatch.setattr(local, "run_task", work)
    pool = LocalPool(jobs=3, threads=1, memory_gb=1.0, gpus=2)
    for n in range(12):
        pool.submit(task(n, gpu=n % 2 == 0))
    found = ends(pool, 12)
    pool.close()
    assert sorted(end.scene for end in found) == list(range(12))
    assert {end.scene: end.code for end in found if end.code != DONE} == {7: FAILED}
    assert most == {False: 3, True: 2} and used == {None, 0, 1}


def test_stopped_it_begins_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    begun = []

    def work(task: Task, stop: Callable[[], bool], gpu: int | None) -> Ended:
        begun.append(task.scene)
        while not stop():
            time.sleep(0.01)
        return Ended(task.scene, STOPPED)

    monkeypatch.setattr(local, "run_task", work)
    pool = LocalPool(jobs=1, threads=1, memory_gb=1.0, gpus=0)
    for n in range(3):
        pool.submit(task(n, gpu=False))
    while not begun:
        time.sleep(0.01)
    pool.stop()
    assert {end.scene: end.code for end in ends(pool, 3)} == {0: STOPPED, 1: STOPPED, 2: STOPPED}
    pool.close()
    assert begun == [0]
