"""Room on the disk: what is left of `budget.disk_gb` and of the disk itself, before a stage and while it writes."""

import shutil
import signal
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from devrf.capture.amounts import GB, size_text
from devrf.pipelines.budget.need import BudgetError
from devrf.pipelines.runner.workspace import nearest, size_of, unfinished

MARGIN, MARGIN_SHARE = 200_000_000, 0.01  # bytes, and share of a small disk, that other programs are left
WATCH_S = 1.0  # a stage writes less than the margin meanwhile, but for the fastest disks


@dataclass(frozen=True)
class Room:
    """What a run may still write.

    Attributes:
        count: Bytes; below 0 where there is too much already.
        bound: What says so, for messages.
        remedy: How there can be more.
        kept: What goes from the run folder leaves no room: a cache on the same disk has it, too.
    """

    count: int
    bound: str
    remedy: str
    kept: bool = False


def room_for(
    run_dir: Path, disk_gb: float | None, cache: Path | None = None, stages: Collection[str] = ()
) -> Room:
    """Room for a run folder, by its budget and by the disk that it lies on, whichever leaves less.

    Args:
        run_dir: The run folder, made or not.
        disk_gb: Its budget.
        cache: Folder of results that are kept for later, and may be deleted.
        stages: About to run: what an earlier run has left of them unfinished counts as room, they go on from it.
    """
    place = nearest(run_dir)
    usage = shutil.disk_usage(place)
    back = unfinished(run_dir, stages) if stages else 0
    free = usage.free - min(MARGIN, int(MARGIN_SHARE * usage.total))
    cached = cache is not None and cache.is_dir() and cache.stat().st_dev == place.stat().st_dev
    spare = f" ({cache} holds results of earlier runs, which can be deleted safely; cache.max_gb bounds it)"
    disk = Room(
        free + back,
        f"{size_text(usage.free)} are free on the disk of {run_dir}",
        f"free some space{spare if cached else ''}, or set output: in scene.yaml to a folder on a larger disk",
        cached,
    )
    if disk_gb is None:
        return disk
    used = size_of(run_dir)
    budget = Room(
        int(disk_gb * GB) - used + back,
        f"budget.disk_gb is {disk_gb:g}, of which {run_dir} holds {size_text(used)}",
        "raise budget.disk_gb, or lower reconstruct.image_scale",
    )
    return min(disk, budget, key=lambda room: room.count)


def no_room(count: int, what: str, room: Room) -> str:
    """What is said of a run or a stage that does not fit on the disk."""
    needed, missing = size_text(count), size_text(count - max(0, room.count))
    return (
        f"{what} needs about {needed} on the disk, {missing} more than there is: {room.bound}; {room.remedy}"
    )


@contextmanager
def watched(run_dir: Path, disk_gb: float | None, cache: Path | None = None) -> Iterator[None]:
    """Stop what is done in this block, by a `BudgetError` in the main thread, once there is no room left.

    Outside of the main thread nothing can be stopped, and nothing is watched.
    """
    problem: list[str] = []
    done = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        if not done.is_set():
            raise BudgetError(problem[0])

    def watch() -> None:
        while not done.wait(WATCH_S):
            room = room_for(run_dir, disk_gb, cache)
            if room.count <= 0:
                problem.append(
                    f"stopped before the disk is full: {room.bound}; {room.remedy}, then run again: finished "
                    "stages are kept"
                )
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR1)
                return

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGUSR1, stop)
    watcher = threading.Thread(target=watch, name="disk", daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()
        signal.signal(signal.SIGUSR1, before)
