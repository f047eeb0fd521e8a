"""Which file of a folder belongs to which picture: mattes and masks are called like a photo, or by a number.

A photo's is called like it (`IMG_1.png`, `IMG_1.jpg.png`), or ends with the same number. Else, or of a film, the number
is the picture's position, from 0; from 1 where they end with the number of pictures, as programs write them that take
films apart.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from devrf.capture.photos.picture_files import PICTURE_SUFFIXES
from devrf.capture.system.errors import CaptureError


@dataclass(frozen=True)
class MatchedFiles:
    """The files of pictures.

    Attributes:
        files: Number of each picture that has one -> its file.
        numbers: Of the files.
        from_1: Whether they count pictures from 1.
    """

    files: dict[int, Path]
    numbers: frozenset[int]
    from_1: bool = False


def files_of(
    files: Sequence[Path], pictures: Mapping[int, str | None], count: int | None = None
) -> MatchedFiles:
    """The file of every picture that has one.

    Args:
        files: Of one folder.
        pictures: Position of each used picture in its film or among the folder's photos -> what the photo was called;
            None of a film's frame.
        count: Frames or photos, used or not; None: not known, and nothing counts from 1.
    Raises:
        CaptureError: They are called like the photos, but one number off.
    """
    by_number = {number: file for file in files if (number := _number(_stem(file.name))) is not None}
    photos = {n: name for n, name in pictures.items() if name is not None}
    own = {n: number for n, name in photos.items() if (number := _number(Path(name).stem)) is not None}
    numbers = frozenset(by_number)
    by_name = {_stem(file.name).lower(): file for file in files}
    named = {n: by_name[s] for n, name in photos.items() if (s := Path(name).stem.lower()) in by_name}
    if named:
        _refuse_one_off(by_number, set(own.values()))
        return MatchedFiles(named, numbers)
    if own and numbers and len(set(own.values())) == len(own) and numbers <= set(own.values()):
        return MatchedFiles({n: by_number[k] for n, k in own.items() if k in by_number}, numbers)
    from_1 = count is not None and max(numbers, default=0) == count and 0 not in numbers
    return MatchedFiles(
        {n: by_number[n + from_1] for n in pictures if n + from_1 in by_number}, numbers, from_1
    )


def _refuse_one_off(files: Mapping[int, Path], photos: set[int]) -> None:
    for step in (1, -1):
        if not photos <= files.keys() and {number + step for number in photos} <= files.keys():
            folder = next(iter(files.values())).parent
            said = [f"from {min(of)} to {max(of)}" for of in (files, photos)]
            wrong = (
                f"{folder}: its {len(files)} files are numbered {said[0]}, the {len(photos)} photos {said[1]}"
            )
            remedy = f"each would be used with the photo beside its own: rename them, {-step:+d} each"
            raise CaptureError("mattes-misnumbered", f"{wrong}; {remedy}")


def _stem(name: str) -> str:
    """The name without the ending, and without a photo's ending before it."""
    stem = Path(name).stem
    return Path(stem).stem if Path(stem).suffix.lower() in PICTURE_SUFFIXES else stem


def _number(stem: str) -> int | None:
    found = re.search(r"(\d+)$", stem)
    return None if found is None else int(found[1])
