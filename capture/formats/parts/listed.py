"""Lists of test pictures: which pictures of a data set the names in them mean."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from devrf.capture.formats.parts.files import read_text, with_slashes
from devrf.capture.system.errors import CaptureError

TEST_LIST = "test.txt"
NAMED = 3  # of those that match nothing, in the row


def read_names(path: Path) -> list[str] | None:
    """Names in a list, one per line; None where there is no list."""
    if not path.is_file():
        return None
    try:
        return [line.strip() for line in read_text(path).splitlines() if line.strip()]
    except OSError as error:
        text = f"{path}: no list of names ({error}); write one name per line, or remove it"
        raise CaptureError("file-damaged", text) from None


def pictures_of_list(
    names: Iterable[str], pictures: Sequence[str], source: str, notes: list[str]
) -> set[int]:
    """Which pictures a list means: by their very names; else by the longest common end of the paths, without regard to
    capitals, and at last without the ending.

    Args:
        names: As the list has them.
        pictures: As the data set names its pictures.
        source: The list, for the row.
        notes: How many names mean no picture, or more than one, is added here.
    """
    names = list(dict.fromkeys(names))
    exact = {with_slashes(picture): n for n, picture in enumerate(pictures)}
    found, unmatched = set(), []
    ways = [_by_end(pictures, whole) for whole in (True, False)]
    for name in names:
        number = exact.get(with_slashes(name))
        for whole, ends in zip((True, False), ways, strict=True):
            if number is None:
                number = _one(_parts(name, whole), ends)
        if number is None:
            unmatched.append(name)
        else:
            found.add(number)
    if unmatched:
        first = ", ".join(unmatched[:NAMED]) + (", ..." if len(unmatched) > NAMED else "")
        instead = "" if found else "; no test picture is named, so they are chosen as if there were no list"
        notes.append(
            f"{source}: {len(unmatched)} of {len(names)} names belong to no picture, or to several: {first}{instead}"
        )
    return found


def _parts(name: str, whole: bool) -> tuple[str, ...]:
    """Folders and name, the last first, in small letters."""
    path = PurePosixPath(with_slashes(name).lower())
    parts = (*path.parent.parts, path.name if whole else path.stem)
    return tuple(part for part in reversed(parts) if part != ".")


def _by_end(pictures: Sequence[str], whole: bool) -> dict[str, list[tuple[tuple[str, ...], int]]]:
    ends: dict[str, list[tuple[tuple[str, ...], int]]] = {}
    for n, picture in enumerate(pictures):
        parts = _parts(picture, whole)
        ends.setdefault(parts[0] if parts else "", []).append((parts, n))
    return ends


def _one(parts: tuple[str, ...], ends: dict[str, list[tuple[tuple[str, ...], int]]]) -> int | None:
    """The picture with the longest common end; None where there is none, or several."""
    candidates = ends.get(parts[0] if parts else "", [])
    common = [(len(os.path.commonprefix([parts, other])), n) for other, n in candidates]
    longest = max((length for length, _ in common), default=0)
    best = [n for length, n in common if length == longest]
    return best[0] if len(best) == 1 else None
