"""The mean picture of a white sheet, from which light fall-off towards the corners is found.

Any source will do: a clip, a folder of photos or one photo. The mean is taken in linear light (sRGB curve), at a small
size: the fall-off is smooth. The sheet may move; what it shows besides white averages out.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.errors import CaptureError
from devrf.capture.light import CLIPPED_SHARE, clipped_share
from devrf.capture.photo_folders import is_photo, list_pictures
from devrf.capture.pictures import read_picture
from devrf.capture.srgb import LINEAR_OF_LEVEL
from devrf.capture.video import VideoReader

SIDE_PX = 64  # a cell averages some 900 pixels of a 1080p picture
DARKEST = 0.02  # linear light of the sheet: below it black level and noise bend the map


def mean_white(path: Path) -> Float[np.ndarray, "rows columns 3"]:
    """Mean picture of a white sheet, linear light [rows, columns, 3], longer side 64.

    Raises:
        InputError: If the file cannot be opened.
        CaptureError: If it is damaged, at white or too dark.
    """
    total, clipped, count = None, 0.0, 0
    for rgb in _pictures(path):
        linear = LINEAR_OF_LEVEL[rgb[:, :, :3]]
        scale = SIDE_PX / max(rgb.shape[:2])
        size = (max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale)))
        small = cv2.resize(linear, size, interpolation=cv2.INTER_AREA).astype(np.float64)
        if total is not None and small.shape != total.shape:
            text = f"{path}: pictures of several sizes; expected those of one camera in one mode"
            raise CaptureError("picture-size-wrong", text)
        total = small if total is None else total + small
        clipped += clipped_share(rgb[:, :, :3])
        count += 1
    if total is None:
        raise CaptureError("pictures-none", f"{path}: no picture of the white sheet; film it again")
    mean, share = total / count, clipped / count
    if share > CLIPPED_SHARE:
        wrong = f"{path}: {100 * share:.0f} % of the white sheet is clipped"
        expected = f"expected at most {100 * CLIPPED_SHARE:.0f} %; film it again at half the exposure"
        raise CaptureError("white-sheet-clipped", f"{wrong}, {expected}")
    if float(np.median(mean)) < DARKEST:
        wrong = f"{path}: the white sheet has {100 * float(np.median(mean)):.1f} % of the full light"
        expected = f"expected at least {100 * DARKEST:.0f} %; film it again with more light"
        raise CaptureError("white-sheet-dark", f"{wrong}, {expected}")
    return mean


def _pictures(path: Path) -> Iterator[UInt8[np.ndarray, "h w c"]]:
    if path.is_dir():
        yield from (read_picture(picture) for picture in list_pictures(path))
    elif is_photo(path):
        yield read_picture(path)
    else:
        with VideoReader(path) as reader:
            yield from (frame.rgb for frame in reader)
