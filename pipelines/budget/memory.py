"""How much main memory a run may hold: `budget.memory_gb`, and never more than the machine and its cgroups leave.

A container's limit is a cgroup's, and cgroups are nested: each one from the process's own up to the root may have a
limit. Version 1 has them in `memory.limit_in_bytes`, version 2 in `memory.max`. Files in the page cache count as used
there, but the kernel drops them before it kills anything, so those that are inactive count as free.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from devrf.capture.system.amounts import GB, size_text
from devrf.capture.system.processes import descendants, memory_of

if TYPE_CHECKING:
    from devrf.pipelines.config.scene import SceneConfig

RESERVE = 0.1  # of what is there: other programs grow, too, ...
MOST_RESERVE = 1_000_000_000  # ... but not with the size of the machine
UNLIMITED = 1 << 60  # version 1 writes a number near 2^63 for no limit


def allowed_bytes(config: "SceneConfig") -> int:
    """Most main memory that this run, with the processes it starts, may hold from now on, bytes.

    `budget.memory_gb`, or all that is left less a reserve where that is less or no budget is given: what a budget
    promises and the machine does not have would end in a kill.
    """
    there = left_bytes() + memory_of([os.getpid(), *descendants(os.getpid())])
    there -= int(min(RESERVE * there, MOST_RESERVE))
    budget = config.budget.memory_gb
    return max(0, there if budget is None else min(there, int(budget * GB)))


def too_much(config: "SceneConfig", needed: int) -> str | None:
    """That so many bytes are more than is allowed, by what, and how there can be more; None where they fit."""
    allowed, budget = allowed_bytes(config), config.budget.memory_gb
    if needed <= allowed:
        return None
    bound = f"{size_text(allowed)} are left on this machine; close other programs, take a larger machine"
    if budget is not None and allowed >= int(budget * GB):
        bound = f"budget.memory_gb is {budget:g}; raise it"
    return f"about {size_text(needed)} of memory, and {size_text(allowed)} are allowed ({bound})"


def left_bytes(proc: Path = Path("/proc"), cgroups: Path | None = None) -> int:
    """What the machine and each cgroup around this process leave now, whichever is least, bytes.

    Args:
        proc: Where the system tells about the process and its cgroups.
        cgroups: Where its cgroups are mounted; None: as `proc` says.
    """
    import psutil

    return min([psutil.virtual_memory().available, *_cgroups_left(proc, cgroups)])


def _cgroups_left(proc: Path, mounted: Path | None) -> Iterator[int]:
    """What each cgroup with a limit leaves."""
    for folder, limit, used, cache in _cgroup_folders(proc, mounted):
        most = _number(folder / limit)
        if most is None or most >= UNLIMITED:
            continue
        droppable = 0
        for line in _lines(folder / "memory.stat"):
            name, _, value = line.partition(" ")
            if name == cache:
                droppable = int(value)
        yield max(0, most - max(0, (_number(folder / used) or 0) - droppable))


def _cgroup_folders(proc: Path, mounted: Path | None) -> Iterator[tuple[Path, str, str, str]]:
    """Folders of the cgroups around this process; names of the files of limit and use, and of the cache in the stat."""
    names = {
        "memory": ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        "": ("memory.max", "memory.current", "inactive_file"),
    }
    for line in _lines(proc / "self" / "cgroup"):
        _, controllers, inside = line.split(":", 2)
        controller = "memory" if "memory" in controllers.split(",") else controllers
        if controller not in names:
            continue
        for mount, root in _mounts(proc, controller, mounted):
            relative = os.path.relpath(inside, root)  # a container's own cgroup may be the root of its mount
            folder = mount if relative.startswith("..") else mount / relative
            while True:
                if folder.is_dir():
                    yield folder, *names[controller]
                if folder == mount or mount not in folder.parents:
                    break
                folder = folder.parent


def _mounts(proc: Path, controller: str, mounted: Path | None) -> Iterator[tuple[Path, str]]:
    """Where the cgroups of a controller ("": version 2) are mounted, and which cgroup is the root there."""
    kind = "cgroup" if controller else "cgroup2"
    for line in _lines(proc / "self" / "mountinfo"):
        before, _, after = line.partition(" - ")
        fields, types = before.split(), after.split()
        if len(fields) > 4 and types and types[0] == kind:
            if not controller or controller in types[-1].split(","):
                place = Path(fields[4])
                yield (place if mounted is None else mounted / place.relative_to("/")), fields[3]


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return []


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text())
    except (OSError, ValueError):  # version 2 writes "max" for no limit
        return None
