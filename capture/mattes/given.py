"""Mattes that people bring: a folder per camera, `static` for the sweep, a file per picture.

A matte is called like its picture (`IMG_1.png` or `IMG_1.jpg.png` for a photo) or by the number of the frame in
its clip (`12.png`, `000012.png`, `frame_000012.png`; `matched_files.py`). White is the subject; grey is partly
transparent; of a file with transparency its opacity counts. Upright, of the picture's size or shape.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.frames import some
from devrf.capture.mattes.matched_files import MatchedFiles, files_of
from devrf.capture.orientation import Upright
from devrf.capture.photos.picture_files import PICTURE_SUFFIXES, read_pixels
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.system.spread import spread

SAME_SHAPE = 0.01  # relative difference of the sides' ratio: the same picture at another size
LOOKED_AT = 12  # mattes of a camera, for whether white and black are swapped
BORDER = 0.02  # of the shorter side
WHITE_AROUND = 0.8  # of the border: no subject fills so much of it and leaves the middle darker
AS_IT_IS = Upright()
LISTED = 4
SWEEP = "static"


def cameras_with_mattes(folder: Path, cameras: Sequence[str], sweep: bool) -> tuple[str, ...]:
    """Which of `static` (where there is a sweep) and the cameras have a folder of mattes.

    Either all have one, or some of the cameras and not the sweep.

    Raises:
        InputError: None has, or the sweep has one and a camera has not.
    """
    wanted = ((SWEEP,) if sweep else ()) + tuple(cameras)
    found = tuple(name for name in wanted if (folder / name).is_dir())
    without = [name for name in wanted if name not in found]
    others = (
        sorted(f.name for f in folder.iterdir() if f.is_dir() and f.name not in wanted) if without else []
    )
    hint = f" (it holds {', '.join(others[:LISTED])})" if others else ""
    if not found:
        called = " or ".join(wanted[:LISTED])
        text = f"{folder}: no folder called {called} in it{hint}; expected one per camera"
        raise InputError("folder-missing", text)
    if SWEEP in found and without:
        wrong = f"{folder}: mattes of the sweep but none of {', '.join(without)}{hint}"
        remedy = "before a plain background every picture needs one: add them, or take static away"
        raise InputError("matte-missing", f"{wrong}; {remedy}")
    return found


def find_mattes(folder: Path, names: Mapping[int, str | None], count: int | None = None) -> MatchedFiles:
    """The matte file of every picture.

    Args:
        folder: Of the camera.
        names: Number of each used frame -> what the photo was called, or None for a film.
        count: Frames or photos of the camera, used or not; None: not known.
    Raises:
        CaptureError: Some have none, or it cannot be told which is whose.
    """
    files = (
        [f for f in sorted(folder.iterdir()) if f.suffix.lower() in PICTURE_SUFFIXES]
        if folder.is_dir()
        else []
    )
    found = files_of(files, names, count)
    films = {index for index, name in names.items() if name is None}
    may_be_from_1 = not found.from_1 and min(found.numbers, default=0) == 1
    if films and 0 not in films and may_be_from_1 and films < found.numbers:
        wrong = (
            f"{folder}: its files are numbered from 1 and are more than the camera's {len(films)} pictures"
        )
        remedy = "frames are counted from 0: rename them, or leave out those of frames that are not used"
        raise CaptureError("mattes-misnumbered", f"{wrong}; {remedy}")
    missing = [index for index in names if index not in found.files]
    if missing:
        called = [f"{n:06d}.png" if (name := names[n]) is None else f"{Path(name).stem}.png" for n in missing]
        raise _missing(folder, called, len(names), may_be_from_1 and 0 in names)
    return found


def read_given(
    file: Path, width: int, height: int, inverted: bool, turn: Upright = AS_IT_IS
) -> UInt8[np.ndarray, "h w"]:
    """A matte at its picture's size.

    Args:
        file: The matte.
        width, height: Of its picture.
        inverted: Whether it shows the subject black.
        turn: From the picture as its own tag makes it upright to the one that is used.
    Raises:
        CaptureError: It cannot be read, or has another shape than its picture.
    """
    matte = _opacity(file)
    if inverted:
        matte = 255 - matte
    if _same_shape(matte.shape[::-1], turn.size(width, height)):
        matte = turn.apply(matte)
    h, w = matte.shape
    if (w, h) == (width, height):
        return matte
    if not _same_shape((w, h), (width, height)):
        wrong = f"{file}: matte is {w}x{h}, its picture {width}x{height} (upright)"
        remedy = "make it from the picture as it was filmed, not cropped or turned"
        raise CaptureError("matte-size-wrong", f"{wrong}; {remedy}")
    return cv2.resize(matte, (width, height), interpolation=cv2.INTER_AREA if w > width else cv2.INTER_LINEAR)


def _same_shape(one: tuple[int, ...], other: tuple[int, ...]) -> bool:
    (w, h), (width, height) = one, other
    return abs(w * height - h * width) <= SAME_SHAPE * h * width


def is_inverted(files: Sequence[Path]) -> bool:
    """Whether a camera's mattes are white around and darker inside, which shows the subject black."""
    around, inside = [], []
    for file in spread(files, LOOKED_AT):
        matte = _opacity(file).astype(np.float32) / 255
        rim = max(1, round(BORDER * min(matte.shape)))
        within = matte[rim:-rim, rim:-rim]
        inside.append(float(within.mean()) if within.size else 0.0)
        around.append(float((matte.sum() - within.sum()) / max(1, matte.size - within.size)))
    return float(np.median(around)) > WHITE_AROUND and float(np.median(inside)) < float(np.median(around))


def _opacity(file: Path) -> UInt8[np.ndarray, "h w"]:
    """Opacity of a cut-out, else its brightness."""
    pixels = read_pixels(file)
    if pixels.shape[2] == 4 and pixels[..., 3].min() < 255:
        return np.ascontiguousarray(pixels[..., 3])
    return pixels[..., :3].max(axis=2)


def _missing(folder: Path, missing: list[str], count: int, from_1: bool) -> CaptureError:
    text = f"{folder}: no matte of {len(missing)} of the camera's {count} pictures: {some(missing)}; "
    if from_1:
        text += "its files are numbered from 1, frames are counted from 0: rename them"
        return CaptureError("mattes-misnumbered", text)
    remedy = "add them (black where no subject is seen), or leave the whole folder out"
    return CaptureError("matte-missing", f"{text}{remedy}")
