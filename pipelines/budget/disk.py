"""Room on the disk: what is left of `budget.disk_gb` and of the disk itself, before a stage and while it writes."""

import shutil
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from devrf.capture.system.amounts import GB, size_text
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.run_folder.workspace import nearest, size_of
from devrf.pipelines.terminal.signals import handled

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

MARGIN, MARGIN_SHARE = 200_000_000, 0.01  # bytes, and share of a small disk, that other programs are left
WATCH_S = 1.0  # a stage writes less than the margin meanwhile, but for the fastest disks


class BudgetError(DevrfError):
    """A stage that cannot be done with what a run may use."""


@dataclass(frozen=True)
class DiskSpace:
    """What a run may still write.

    Attributes:
        count: Bytes; below 0 where there is too much already.
        bound: What says so, for messages.
        remedy: How there can be more.
    """

    count: int
    bound: str
    remedy: str


def room_of(config: "SceneConfig", run_dir: Path) -> DiskSpace:
    """Room for a run folder: on the disk that it lies on, or of its budget, whichever leaves less.

    Args:
        config: Has the budget.
        run_dir: The run folder, made or not.
    """
    usage, disk_gb = shutil.disk_usage(nearest(run_dir)), config.budget.disk_gb
    disk = DiskSpace(
        usage.free - min(MARGIN, int(MARGIN_SHARE * usage.total)),
        f"{size_text(usage.free)} are free on the disk of {run_dir}",
        "free some space, or set output: in scene.yaml to a folder on a larger disk",
    )
    if disk_gb is None:
        return disk
    used = size_of(run_dir)
    budget = DiskSpace(
        int(disk_gb * GB) - used,
        f"budget.disk_gb is {disk_gb:g}, of which {run_dir} holds {size_text(used)}",
        "raise budget.disk_gb, or lower reconstruct.image_scale",
    )
    return min(disk, budget, key=lambda room: room.count)


def check_room(config: "SceneConfig", run_dir: Path) -> None:
    """Make sure that something can still be written.

    Raises:
        BudgetError: There is no room.
    """
    room = room_of(config, run_dir)
    if room.count <= 0:
        raise BudgetError(
            "disk-full",
            f"stopped before the disk is full: {room.bound}; {room.remedy}, then run again: finished stages are kept",
        )


@contextmanager
def watched(config: "SceneConfig", run_dir: Path) -> Iterator[None]:
    """Stop what is done in this block, by a `BudgetError` in the main thread, once there is no room left.

    Outside of the main thread nothing can be stopped, and nothing is watched.
    """
    problem: list[BudgetError] = []
    done = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        if not done.is_set():
            raise problem[0]

    def watch() -> None:
        while not done.wait(WATCH_S):
            try:
                check_room(config, run_dir)
            except BudgetError as error:
                problem.append(error)
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
                return

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    with handled(stop, signal.SIGUSR1):
        watcher = threading.Thread(target=watch, name="disk", daemon=True)
        watcher.start()
        try:
            yield
        finally:
            done.set()
            watcher.join()
