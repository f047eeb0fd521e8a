"""Mattes of one camera's pictures, given or by a screen: written as grey PNG of the picture's size, and measured."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.mattes.chroma import chroma_matte, find_key, is_screen_hue
from devrf.capture.mattes.given import AS_IT_IS, find_mattes, is_inverted, read_given
from devrf.capture.mattes.matte_facts import MatteFacts, measure
from devrf.capture.orientation import Upright
from devrf.capture.photos.picture_files import read_pixels, write_png
from devrf.capture.system.cores import usable_cores
from devrf.capture.system.progress import Progress, no_progress

Source = Callable[[int, UInt8[np.ndarray, "h w c"]], UInt8[np.ndarray, "h w"]]


@dataclass(frozen=True)
class MatteClip:
    """One camera's used pictures.

    Attributes:
        camera: Its name; `static` for the sweep.
        files: The pictures, in order.
        names: Number of each frame, in the same order -> what the photo was called; None for a film.
        small_sizes: (width, height) of each picture's `MatteFacts.small`.
        turns: Of each picture, from what its own tag makes upright to what is used; empty: none.
        count: Frames or photos of the camera, used or not; None: not known.
    """

    camera: str
    files: tuple[Path, ...]
    names: Mapping[int, str | None]
    small_sizes: tuple[tuple[int, int], ...]
    turns: tuple[Upright, ...] = ()
    count: int | None = None


@dataclass(frozen=True)
class CameraMattes:
    """What was made for one camera.

    Attributes:
        files: A matte per picture.
        facts: What each says about itself.
        inverted: Whether given mattes were found to show the subject black.
        from_1: Whether given mattes count the camera's pictures from 1.
        key_rgb: The screen's colour, 0 to 255.
        doubtful_key: Whether that colour was found, not named, and is neither a green nor a blue screen's.
    """

    files: tuple[Path, ...]
    facts: tuple[MatteFacts, ...]
    inverted: bool = False
    from_1: bool = False
    key_rgb: tuple[float, float, float] | None = None
    doubtful_key: bool = False


def given_mattes(
    clip: MatteClip, folder: Path, inverted: bool | None, out: Path, progress: Progress = no_progress
) -> CameraMattes:
    """Mattes that people bring, out of the camera's folder; `inverted` None finds out."""
    matched = find_mattes(folder, clip.names, clip.count)
    found = [matched.files[index] for index in clip.names]
    swapped = is_inverted(found) if inverted is None else inverted

    def source(n: int, picture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w"]:
        turn = clip.turns[n] if clip.turns else AS_IT_IS
        return read_given(found[n], picture.shape[1], picture.shape[0], swapped, turn)

    files, facts = _write(clip, source, out, progress)
    return CameraMattes(files, facts, inverted=swapped and inverted is None, from_1=matched.from_1)


def chroma_mattes(
    clip: MatteClip, colour: Float[np.ndarray, "3"] | None, out: Path, progress: Progress = no_progress
) -> CameraMattes:
    """Mattes by a screen's colour, RGB in 0 to 255; None finds it."""
    key = find_key(clip.camera, clip.files) if colour is None else colour

    def source(n: int, picture: UInt8[np.ndarray, "h w c"]) -> UInt8[np.ndarray, "h w"]:
        return chroma_matte(picture, key)

    files, facts = _write(clip, source, out, progress)
    red, green, blue = (float(value) for value in key)
    doubtful = colour is None and not is_screen_hue(key)
    return CameraMattes(files, facts, key_rgb=(red, green, blue), doubtful_key=doubtful)


def _write(
    clip: MatteClip, source: Source, out: Path, progress: Progress
) -> tuple[tuple[Path, ...], tuple[MatteFacts, ...]]:
    """Make, measure and write the mattes, some at a time; they are called like the pictures."""
    folder = out / clip.camera
    folder.mkdir(parents=True)

    def one(n: int) -> tuple[Path, MatteFacts]:
        picture = read_pixels(clip.files[n])
        matte, path = source(n, picture), folder / f"{clip.files[n].stem}.png"
        write_png(path, matte)
        return path, measure(matte, clip.small_sizes[n])

    made = []
    with ThreadPoolExecutor(usable_cores()) as pool:
        for result in pool.map(one, range(len(clip.files))):
            made.append(result)
            progress(len(made) / len(clip.files), f"{clip.camera}: matte {len(made)} of {len(clip.files)}")
    return tuple(path for path, _ in made), tuple(facts for _, facts in made)
