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
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.runner.workspace import nearest, size_of, unfinished
from devrf.pipelines.stamps.cache import cache_of

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


def rooms_of(config: SceneConfig, scene_dir: Path, run_dir: Path, stages: Collection[str] = ()) -> list[Room]:
    """Room for a run folder: on the disk that it lies on, and of its budget.

    Args:
        config: Has the budget; and names the cache, whose results can be deleted.
        scene_dir: Folder of scene.yaml.
        run_dir: The run folder, made or not.
        stages: About to run: what an earlier run has left of them unfinished counts as room, they go on from it.
    """
    place, cache, disk_gb = nearest(run_dir), cache_of(config, scene_dir), config.budget.disk_gb
    usage = shutil.disk_usage(place)
    back = unfinished(run_dir, stages) if stages else 0
    free = usage.free - min(MARGIN, int(MARGIN_SHARE * usage.total))
    kept = cache is not None and cache.folder.is_dir() and cache.folder.stat().st_dev == place.stat().st_dev
    spare = (
        f" ({cache.folder} holds results of earlier runs, which can be deleted safely; cache.max_gb bounds it)"
        if cache is not None and kept
        else ""
    )
    disk = Room(
        free + back,
        f"{size_text(usage.free)} are free on the disk of {run_dir}",
        f"free some space{spare}, or set output: in scene.yaml to a folder on a larger disk",
        kept,
    )
    if disk_gb is None:
        return [disk]
    used = size_of(run_dir)
    budget = Room(
        int(disk_gb * GB) - used + back,
        f"budget.disk_gb is {disk_gb:g}, of which {run_dir} holds {size_text(used)}",
        "raise budget.disk_gb, or lower reconstruct.image_scale",
    )
    return [disk, budget]


def room_of(config: SceneConfig, scene_dir: Path, run_dir: Path, stages: Collection[str] = ()) -> Room:
    """Whichever of `rooms_of` leaves less."""
    return min(rooms_of(config, scene_dir, run_dir, stages), key=lambda room: room.count)


def no_room(count: int, what: str, room: Room) -> str:
    """What is said of a run or a stage that does not fit on the disk."""
    needed, missing = size_text(count), size_text(count - max(0, room.count))
    return (
        f"{what} needs about {needed} on the disk, {missing} more than there is: {room.bound}; {room.remedy}"
    )


@contextmanager
def watched(config: SceneConfig, scene_dir: Path, run_dir: Path) -> Iterator[None]:
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
            room = room_of(config, scene_dir, run_dir)
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
