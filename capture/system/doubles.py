"""Files that hold the same bytes."""

import filecmp
import hashlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

HEAD = 1 << 16  # bytes that tell most files of one size apart: pictures that are not compressed


def doubles(files: Sequence[Path]) -> dict[int, int]:
    """Which files are others again, under another name or the same: number of each -> of the first that holds the same.

    Only files of one size are read, so that asking costs nothing where there are none.

    Raises:
        OSError: A file cannot be read.
    """
    paths = [file.resolve() for file in files]
    first: dict[Path, int] = {}
    found = {n: first[path] for n, path in enumerate(paths) if first.setdefault(path, n) != n}
    size = {path: path.stat().st_size for path in first}
    counts = Counter(size.values())
    alike: dict[tuple[int, bytes], list[int]] = {}
    for path, n in first.items():
        if counts[size[path]] > 1:
            group = alike.setdefault((size[path], _head(path)), [])
            same = [k for k in group if filecmp.cmp(paths[k], path, shallow=False)]
            if same:
                found[n] = same[0]
            else:
                group.append(n)
    return {n: found.get(k, k) for n, k in found.items()}


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return hashlib.blake2b(file.read(HEAD), digest_size=16).digest()
