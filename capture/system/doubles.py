"""Files that hold the same bytes."""

import filecmp
from collections.abc import Sequence
from pathlib import Path


def doubles(files: Sequence[Path]) -> dict[int, int]:
    """Which files are others again: number of each -> of the first that holds the same.

    Only files of one size are read, so that asking costs nothing where there are none.

    Raises:
        OSError: A file cannot be read.
    """
    found: dict[int, int] = {}
    by_size: dict[int, list[int]] = {}
    by_path: dict[Path, int] = {}
    for n, file in enumerate(files):
        path = file.resolve()
        first = by_path.setdefault(path, n)
        if first == n:
            alike = by_size.setdefault(path.stat().st_size, [])
            first = next((k for k in alike if filecmp.cmp(files[k], path, shallow=False)), n)
            if first == n:
                alike.append(n)
        if first != n:
            found[n] = found.get(first, first)
    return found
