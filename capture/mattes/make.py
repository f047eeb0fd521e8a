"""Mattes of one camera's pictures, given or by a screen: written as grey PNG of the picture's size, and measured."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.cores import usable_cores
from devrf.capture.mattes.chroma import chroma_matte, find_key, is_screen_hue, key_share
from devrf.capture.mattes.given import find_mattes, is_inverted, read_given
from devrf.capture.mattes.measure import MatteFacts, measure
from devrf.capture.picture_files import read_pixels, write_png
from devrf.capture.progress import Progress, no_progress

SPILL_PX = 3, 9  # behind the edge, where a good matte is opaque: light of the screen on the subject lies here

Source = Callable[[int, UInt8[np.ndarray, "h w c"]], UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Clip:
    """One camera's used pictures.

    Attributes:
        camera: Its name; `static` for the sweep.
        files: The pictures, in order.
        names: Number of each frame, in the same order -> what the photo was called; None for a film.
        small_sizes: (width, height) of each picture's `MatteFacts.small`.
    """

    camera: str
    files: tuple[Path, ...]
    names: Mapping[int, str | None]
    small_sizes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class CameraMattes:
    """What was made for one camera.

    Attributes:
        files: A matte per picture.
        facts: What each says about itself.
        inverted: Whether given mattes were found to show the subject black.
        key_rgb: The screen's colour, 0 to 255.
        doubtful_key: Whether that colour was found, not named, and is neither a green nor a blue screen's.
        spill: Share of the screen's colour within the subject's edge; None without a screen.
    """

    files: tuple[Path, ...]
    facts: tuple[MatteFacts, ...]
    inverted: bool = False
    key_rgb: tuple[float, float, float] | None = None
    doubtful_key: bool = False
    spill: float | None = None


def given_mattes(
    clip: Clip, folder: Path, inverted: bool | None, out: Path, progress: Progress = no_progress
) -> CameraMattes:
    """Mattes that people bring, out of the camera's folder; `inverted` None finds out."""
    found = find_mattes(folder, clip.names)
    swapped = is_inverted(found) if inverted is None else inverted

    def source(n: int, picture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w"]:
        return read_given(found[n], picture.shape[1], picture.shape[0], swapped)

    files, facts = _write(clip, source, out, progress)
    return CameraMattes(files, facts, inverted=swapped and inverted is None)


def chroma_mattes(
    clip: Clip, colour: Float[np.ndarray, "3"] | None, out: Path, progress: Progress = no_progress
) -> CameraMattes:
    """Mattes by a screen's colour, RGB in 0 to 255; None finds it."""
    key = find_key(clip.camera, clip.files) if colour is None else colour
    spills: list[float] = []

    def source(n: int, picture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w"]:
        matte = chroma_matte(picture, key)
        near, far = (
            cv2.erode((matte > 127).astype(np.uint8), np.ones((2 * r + 1,) * 2, np.uint8)) for r in SPILL_PX
        )
        band = (near > 0) & (far == 0)
        if band.any():
            spills.append(float(np.clip(key_share(picture, key)[band], 0, 1).mean()))
        return matte

    files, facts = _write(clip, source, out, progress)
    red, green, blue = (float(value) for value in key)
    spill = float(np.median(spills)) if spills else None
    doubtful = colour is None and not is_screen_hue(key)
    return CameraMattes(files, facts, key_rgb=(red, green, blue), doubtful_key=doubtful, spill=spill)


def _write(
    clip: Clip, source: Source, out: Path, progress: Progress
) -> tuple[tuple[Path, ...], tuple[MatteFacts, ...]]:
    """Make, measure and write the mattes, some at a time; they are called like the pictures."""
    folder = out / clip.camera
    folder.mkdir(parents=True)

    def one(n: int) -> tuple[Path, MatteFacts]:
        picture = read_pixels(clip.files[n])
        matte, path = source(n, picture), folder / f"{clip.files[n].stem}.png"
        write_png(path, matte)
        return path, measure(picture, matte, clip.small_sizes[n])

    made = []
    with ThreadPoolExecutor(usable_cores()) as pool:
        for result in pool.map(one, range(len(clip.files))):
            made.append(result)
            progress(len(made) / len(clip.files), f"{clip.camera}: matte {len(made)} of {len(clip.files)}")
    return tuple(path for path, _ in made), tuple(facts for _, facts in made)
