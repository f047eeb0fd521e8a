"""Make a film: every picture is rendered, or taken where it is kept, and encoded beside that; then it gets its name."""

import shutil
import time as clock
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devrf.capture.picture_files import open_picture
from devrf.capture.progress import Progress
from devrf.capture.video_writer import video_beside
from devrf.pipelines.film.draw import Drawer
from devrf.pipelines.film.kept import MADE_FROM, Kept

WEBP_QUALITY = 70
WEBP_EFFORT = 6  # of 6: small files, slowly


@dataclass(frozen=True)
class Made:
    """How a film came about.

    Attributes:
        rendered: Pictures that were rendered now; the others were kept.
        seconds: That all of it took.
        render_s: Of these, rendering.
    """

    rendered: int
    seconds: float
    render_s: float


def make(drawer: Drawer, kept: Kept, progress: Progress) -> Made:
    """Leave the whole film in the folder of `kept`.

    Raises:
        OSError, CaptureError: It cannot be written; what was made is kept.
    """
    film, begin, rendered = drawer.film, clock.perf_counter(), 0
    with ExitStack() as stack:
        encoders = {}
        if film.format == "mp4":
            for layer in film.layers:
                encoders[layer] = stack.enter_context(video_beside(kept.folder / f"{layer}.mp4", film.fps))
        writer = stack.enter_context(kept.writing())
        for n in range(film.count):
            picture = kept.read(drawer.files(n))
            if picture is None:
                picture = drawer.draw(n)
                writer.put(picture)
                rendered += 1
            for layer, put in encoders.items():
                shown = picture[f"{layer}/{n:06d}.png"]
                assert isinstance(shown, np.ndarray)
                put(shown)
            progress((n + 1) / film.count, f"{n + 1} of {film.count} pictures")
    if film.format == "webp":
        for layer in film.layers:
            _write_webp(kept.folder / f"{layer}.webp", sorted((kept.folder / layer).glob("*.png")), film.fps)
    return Made(rendered, clock.perf_counter() - begin, drawer.render_s)


def finish(drawer: Drawer, kept: Kept, folder: Path) -> None:
    """Give a film that is made its name; an earlier one of that name goes."""
    if drawer.film.format != "png":
        for layer in drawer.film.layers:
            shutil.rmtree(kept.folder / layer)
    (kept.folder / MADE_FROM).unlink()
    if folder.exists():
        shutil.rmtree(folder)
    kept.folder.rename(folder)


def _write_webp(path: Path, pictures: list[Path], fps: float) -> None:
    """One animated picture that repeats for ever."""
    with ExitStack() as stack:
        first, *rest = (stack.enter_context(open_picture(picture)) for picture in pictures)
        first.save(  # reads the pixels of one after the other
            path,
            format="WEBP",
            save_all=True,
            append_images=rest,
            duration=round(1000 / fps),
            loop=0,
            quality=WEBP_QUALITY,
            method=WEBP_EFFORT,
        )
