"""How many cores this process is meant to use."""

import os


def usable_cores() -> int:
    """Cores this process may run on, at most `OMP_NUM_THREADS`.

    The variable is what users and schedulers set to share a machine; numerical libraries heed it by themselves.
    """
    there = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wished = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]  # a list is one number per level of nesting
    return min(there, int(wished)) if wished.isdecimal() and int(wished) > 0 else there
