"""The colours of a chart of 24 patches (Macbeth, ColorChecker Classic) in a picture or clip.

Found by OpenCV's detector (`cv2.mcc`), upside down or not. All cameras film the same chart in the same light; nothing
is assumed of its printed colours, so an old or a copied chart does as well.
"""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.calibration.colour.surface import WHITE_LEVEL, Pairs
from devrf.capture.errors import CalibrationError
from devrf.capture.look import Look
from devrf.capture.picture_files import PICTURE_SUFFIXES
from devrf.capture.pictures import read_picture
from devrf.capture.raw import is_raw
from devrf.capture.srgb import linear_from_srgb
from devrf.capture.video import VideoReader

COLUMNS = 6
EVERY, LOOKED_AT = 5, 40  # every 5th picture of a clip, at most 40 of them
ENOUGH = 5  # pictures with the chart: their median is free of a hand's shadow and of noise
FEWEST_PATCHES = 12  # unclipped ones of the 24: half of them still hold all hues
COLOURFUL = 0.1  # spread of R-G over the patches, share of their light: a grey checkerboard has none


def read_chart(path: Path, look: Look | None = None) -> Float[np.ndarray, "24 3"]:
    """Linear light of a chart's patches, row by row from the brown one; NaN where one is clipped.

    Args:
        path: A photo or a clip.
        look: Applied to its pictures first (fall-off of the lens).
    Raises:
        InputError: The file is not a picture or clip.
        CalibrationError: No chart is found, or most of its patches are clipped.
    """
    seen: list[np.ndarray] = []
    count = 0
    for rgb in _pictures(path):
        count += 1
        patches = _patches(rgb if look is None else look.apply(rgb))
        if patches is not None:
            seen.append(patches)
        if len(seen) == ENOUGH:
            break
    if not seen:
        wrong = f"{path}: no colour chart in {count} picture{'s' if count > 1 else ''}"
        remedy = (
            "expected a chart of 6 x 4 patches that fills a quarter of the picture, unhidden and evenly lit"
        )
        raise CalibrationError("chart-unfound", f"{wrong}; {remedy}")
    colours = np.median(seen, axis=0)
    whole = int(np.isfinite(colours).all(axis=1).sum())
    if whole < FEWEST_PATCHES:
        wrong = f"{path}: {24 - whole} of the chart's 24 patches are clipped, expected at most {24 - FEWEST_PATCHES}"
        remedy = "film it again at half the exposure, and the scene as well"
        raise CalibrationError("chart-clipped", f"{wrong}; {remedy}")
    return colours


def chart_pairs(
    first: str, first_chart: Float[np.ndarray, "24 3"], second: str, second_chart: Float[np.ndarray, "24 3"]
) -> Pairs:
    """The patches that both cameras show unclipped."""
    both = np.isfinite(first_chart).all(axis=1) & np.isfinite(second_chart).all(axis=1)
    column, row = np.arange(24) % COLUMNS, np.arange(24) // COLUMNS
    place = (np.column_stack([column, row]) + 0.5) / 16  # each patch a tile of its own
    return Pairs(first, second, np.stack([first_chart, second_chart], axis=1)[both], place[both], alike=1)


def _patches(rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "24 3"] | None:
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setColorChartType(cv2.mcc.MCC24)
    if not detector.process(np.ascontiguousarray(rgb[..., ::-1]), 1):
        return None
    # rows: patch by patch R, G, B; columns: pixels, mean, deviation, least, greatest
    table = np.array(detector.getBestColorChecker().getChartsRGB(True)).reshape(24, 3, 5)
    linear = linear_from_srgb(table[..., 1] / 255)
    if np.std(linear[:, 0] - linear[:, 1]) < COLOURFUL * linear.mean():
        return None
    return np.where((table[..., 4] < WHITE_LEVEL).all(axis=1, keepdims=True), linear, np.nan)


def _pictures(path: Path) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
    if path.suffix.lower() in PICTURE_SUFFIXES or is_raw(path):
        yield np.ascontiguousarray(read_picture(path)[..., :3])
        return
    with VideoReader(path) as clip:
        for frame in clip:
            if frame.index % EVERY == 0:
                yield frame.rgb
            if frame.index >= EVERY * (LOOKED_AT - 1):
                return
