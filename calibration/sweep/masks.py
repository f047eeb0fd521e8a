"""Masks of what moves or reflects in a sweep: black is ignored (COLMAP's convention).

A picture's mask has its size and its name plus `.png` (`IMG_1.jpg.png`), or its name with `.png` instead
(`IMG_1.png`); a film's frame is called by its number (`000012.png` or `12.png`; `capture/mattes/matched_files.py`).
"""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from devrf.capture.mattes.matched_files import files_of
from devrf.capture.orientation import Upright
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.system.errors import InputError

GROWN = 0.01  # of the longer side: contact shadows, and the width of the filter that finds a feature
BLACK_BELOW = 128  # of 255; masks saved as JPEG or resized are not quite black and white
LISTED = 4


def prepare_masks(
    folder: Path,
    pictures: Mapping[str, str],
    sizes: Mapping[str, tuple[int, int]],
    out: Path,
    turns: Mapping[str, Upright] | None = None,
    count: int | None = None,
) -> tuple[list[str], bool]:
    """Write every picture's mask, what is ignored grown a little, where COLMAP looks for it.

    Args:
        folder: The user's masks.
        pictures: Name of each picture (relative to the picture folder) -> what it was called when filmed.
        sizes: (width, height) of each picture.
        out: Folder for COLMAP's masks.
        turns: From each picture as its own tag makes it upright to the one that is used; None: they are the same.
        count: Frames or photos, used or not; None: not known.
    Returns:
        Pictures without a mask, all of which is used; and whether masks count pictures from 1.
    Raises:
        InputError: No folder, no mask at all, a mask of another size, or one that ignores everything.
        CaptureError: They are called like the photos, but one number off.
    """
    if not folder.is_dir():
        text = f"{folder}: no such folder; check calibration.static_poses.masks in scene.yaml"
        raise InputError("folder-missing", text)
    without, problems = [], []
    called = {int(Path(n).stem): None if Path(n).name == filmed else filmed for n, filmed in pictures.items()}
    found = files_of(sorted(folder.glob("*.png")), called, count)
    for name, original in pictures.items():
        file = found.files.get(int(Path(name).stem))
        if file is None:
            without.append(name)
            continue
        keep = read_pixels(file)[:, :, :3].max(axis=2) >= BLACK_BELOW
        turn = (turns or {}).get(name, Upright())
        if keep.shape[::-1] == turn.size(*sizes[name]):
            keep = turn.apply(keep.astype(np.uint8)).astype(bool)
        if keep.shape[::-1] != sizes[name]:
            size, want = "x".join(map(str, keep.shape[::-1])), "x".join(map(str, sizes[name]))
            text = f"{file}: {size}, the picture {original} is {want} (upright); save it at that size"
            problems.append(InputError("mask-size-wrong", text))
            continue
        side = 2 * max(2, round(GROWN * max(keep.shape))) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
        kept = cv2.erode(keep.astype(np.uint8) * 255, disc, borderType=cv2.BORDER_REPLICATE)
        if not kept.any():
            wrong = f"{file}: ignores the whole picture; black is ignored, white is used"
            remedy = "invert the mask, or take the picture out of the sweep"
            problems.append(InputError("mask-ignores-all", f"{wrong}: {remedy}"))
            continue
        target = out / f"{name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), kept)
    if problems:
        more = f"\n(and {len(problems) - LISTED} more)" if len(problems) > LISTED else ""
        raise InputError(problems[0].code, "\n".join(map(str, problems[:LISTED])) + more)
    if len(without) == len(pictures):
        example = next(iter(pictures.values()))
        wrong = f"{folder}: holds no mask of the sweep's {len(pictures)} pictures"
        raise InputError("mask-missing", f"{wrong}; expected names such as {example}.png")
    return without, found.from_1
