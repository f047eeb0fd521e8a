"""LLFF's layout: `poses_bounds.npy` and `images/`; one row per picture, in the order of their names by code points.

A row is a 3x5 matrix [R | t | height, width, focal] and the nearest and farthest depth. Its R has the columns
down, right, back in the world; t is the camera's centre. Square pixels, principal point at the middle.
Our addition: `test.txt`, names of the test pictures, one per line.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.formats.parts.files import Header, read_header
from devrf.capture.formats.parts.listed import TEST_LIST, pictures_of_list, read_names
from devrf.capture.formats.parts.opengl import cam_from_opengl
from devrf.capture.formats.parts.row_order import order_that_fits
from devrf.capture.photos.picture_files import PICTURE_SUFFIXES, natural_key
from devrf.capture.scene import PosedFrame
from devrf.capture.system.amounts import some
from devrf.capture.system.arrays import ArrayError, read_npy
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.file_names import CLIP_SUFFIXES

POSES = "poses_bounds.npy"
FACTORS = ("", "_2", "_4", "_8")  # endings of folders with smaller copies, the largest first

Rows = tuple[tuple[PosedFrame, ...], Float[np.ndarray, "n 2"]]


def read_llff(folder: Path, notes: list[str]) -> Pictures:
    """A forward-facing scene at rest."""
    rows = read_rows(folder / POSES, 17)
    names = read_names(folder / TEST_LIST)
    frames, bounds = llff_frames(folder, rows, notes)
    test = pictures_of_list(names or [], [f.path.name for f in frames], TEST_LIST, notes)
    frames = tuple(replace(f, split="test") if n in test else f for n, f in enumerate(frames))
    return Pictures(frames, has_split=names == [] or bool(test), bounds=bounds, behind="black")


def llff_frames(folder: Path, rows: Float[np.ndarray, "n 17"], notes: list[str]) -> Rows:
    """Pictures at rest with their cameras, and their bounds [n, 2], in LLFF's world.

    A row belongs to `largest_pictures` by the code points of their names, as LLFF's own tools sort them; by the numbers
    in the names where what the pictures share says so.

    Raises:
        CaptureError: As of `largest_pictures`, or a row that is no camera of its picture.
    """
    files, numbered = largest_pictures(folder, len(rows), str), largest_pictures(folder, len(rows))
    if files == numbered:
        return _frames(folder, rows, files, notes)
    said: tuple[list[str], list[str]] = ([], [])
    read = [_frames(folder, rows, order, of) for order, of in zip((files, numbered), said, strict=True)]
    fits = order_that_fits([frames for frames, _ in read])
    chosen = fits or 0
    first = ", ".join(file.name for file in (files, numbered)[chosen][:3])
    wrong = f"{folder.name}: rows of poses_bounds.npy are taken to be in the order of"
    by_code, share = "names sorted by code points", "what pictures share fits"
    if chosen:
        notes.append(f"{wrong} the numbers in their names ({first}, ...): so {share}, not by {by_code}")
    else:
        why = "as LLFF's tools write them" + ("" if fits is None else f", and {share}")
        notes.append(
            f"{wrong} {by_code} ({first}, ...), {why}; by the numbers in the names the cameras would be others"
        )
    notes += said[chosen]
    return read[chosen]


def _frames(folder: Path, rows: Float[np.ndarray, "n 17"], files: list[Path], notes: list[str]) -> Rows:
    path = folder / POSES
    headers = [read_header(file) for file in files]
    grey = sum(header.grey for header in headers)
    if grey:
        notes.append(f"{files[0].parent.name}: {grey} grey pictures, read as RGB")
    bounds = check_bounds(rows[:, 15:], path)
    frames = []
    for n, (row, header) in enumerate(zip(rows, headers, strict=True)):
        where = f"{path}: row {n} ({header.path.name})"
        matrix = row[:15].reshape(3, 5)
        opengl = np.column_stack([matrix[:, 1], -matrix[:, 0], matrix[:, 2:4]])
        frames.append(
            PosedFrame(
                header.path, pinhole(opengl, matrix[:, 4], header, where), "static", n, None, None, "train"
            )
        )
    return tuple(frames), bounds


def pinhole(
    opengl: Float[np.ndarray, "3 4"], hwf: Float[np.ndarray, "3"], header: Header, where: str
) -> Camera:
    """The camera of a row; its focal length is scaled from the size in the row to that of the picture."""
    height, width, focal = hwf
    if not (np.isfinite(hwf).all() and hwf.min() > 0):
        text = f"{where}: height, width, focal are {hwf.tolist()}; expected numbers above 0"
        raise CaptureError("entry-wrong", text)
    ratio_x, ratio_y = header.width / width, header.height / height
    # copies have rounded sizes
    if abs(ratio_x / ratio_y - 1) > 1.5 / min(header.width, header.height) + 1e-3:
        wrong = f"{header.path}: picture is {header.size}, {where} says {width:g}x{height:g}"
        remedy = "expected the same shape; use the pictures that were calibrated"
        raise CaptureError("picture-size-wrong", f"{wrong}; {remedy}")
    K = np.array([[focal * ratio_x, 0, header.width / 2], [0, focal * ratio_y, header.height / 2], [0, 0, 1]])
    return Camera(header.width, header.height, K, cam_from_opengl(opengl, where))


def read_rows(path: Path, columns: int) -> Float[np.ndarray, "n columns"]:
    """Rows of a table of poses or bounds.

    Raises:
        CaptureError: Missing, damaged, or of another shape.
    """
    try:
        table = read_npy(path).astype(np.float64)
    except ArrayError as error:
        remedy = "expected a table of numbers: copy it again, or check dataset.path and dataset.format"
        raise CaptureError(error.code, f"{error}; {remedy}") from None
    if table.ndim < 2 or len(table) == 0 or table[0].size != columns:
        text = f"{path}: has shape {list(table.shape)}; expected one row of {columns} numbers per picture"
        raise CaptureError("table-wrong", text)
    return table.reshape(len(table), columns)


def check_bounds(bounds: Float[np.ndarray, "n 2"], path: Path) -> Float[np.ndarray, "n 2"]:
    """Bounds [n, 2] as they are, where they can be depths.

    Raises:
        CaptureError: A row has not 0 < near < far.
    """
    good = np.isfinite(bounds).all(axis=1) & (bounds[:, 0] > 0) & (bounds[:, 1] > bounds[:, 0])
    if not good.all():
        n = int(np.argmin(good))
        wrong = f"{path}: bounds of row {n} are {bounds[n].tolist()}; expected 0 < near < far"
        raise CaptureError("entry-wrong", f"{wrong}; the picture saw no points: remove its row and its file")
    return bounds


def largest_pictures(folder: Path, count: int | None, key: Callable[[str], Any] = natural_key) -> list[Path]:
    """Pictures of `images`, else of `images_2`, `images_4`, `images_8`, their names sorted by `key`.

    Raises:
        CaptureError: None of these holds `count` pictures (any, where `count` is None).
    """
    seen = []
    for factor in FACTORS:
        files = pictures_in(folder / f"images{factor}", key)
        if files and count in (None, len(files)):
            return files
        if files:
            seen.append(f"images{factor} {len(files)}")
    expected = f"{count} pictures" if count is not None else "pictures"
    wrong = f"{folder}: expected {expected} in images, images_2, images_4 or images_8"
    clips = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in CLIP_SUFFIXES)
    if clips and not seen:
        text = (
            f"{wrong}, found {len(clips)} clips ({some(clips)}): a capture of fixed cameras; name them in "
            f"capture.cameras, {POSES} in calibration.rig.given, and a sweep of the scene at rest in capture.static"
        )
        raise CaptureError("count-mismatch", text)
    text = f"{wrong}, found {', '.join(seen) or 'none'}; each row of the poses is one picture"
    raise CaptureError("count-mismatch", text)


def pictures_in(folder: Path, key: Callable[[str], Any] = natural_key) -> list[Path]:
    """Pictures of a folder, their names sorted by `key`; none where there is no such folder."""
    if not folder.is_dir():
        return []
    files = [
        p for p in folder.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES and not p.name.startswith(".")
    ]
    return [p.resolve() for p in sorted(files, key=lambda p: key(p.name))]
