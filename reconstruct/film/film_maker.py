"""The maker of films: every picture is rendered, and encoded or written beside that."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import to_8_bits, write_png
from devrf.capture.system.progress import Progress
from devrf.capture.video.video_writer import video_beside
from devrf.reconstruct.film.depth_layer import DepthScale, depth_colours, depth_steps, planar_depth
from devrf.reconstruct.rendering.model import DynamicModel, render_layers

Put = Callable[[np.ndarray], None]


@dataclass(frozen=True)
class Film:
    """A film to make.

    Attributes:
        cameras: Of every picture, in the box frame.
        times: Of every picture in [0, 1]; None where the scene is at rest.
        fps: Pictures a second.
        names: By layer (colour, depth) the name of its file without a suffix, or of its folder.
        format: mp4, which shows depth in colours, or png: a folder of pictures, depth in steps of 16 bits.
        depth: How depth is shown; needed where that layer is asked for.
        still: The picture that stands for the film; None: the one in its middle.
    """

    cameras: tuple[Camera, ...]
    times: tuple[float | None, ...]
    fps: float
    names: Mapping[str, str]
    format: str = "mp4"
    depth: DepthScale | None = None
    still: int | None = None

    @property
    def count(self) -> int:
        """Number of pictures."""
        return len(self.cameras)


def make_film(
    film: Film, model: DynamicModel, folder: Path, progress: Progress
) -> UInt8[np.ndarray, "height width 3"]:
    """Write a film's layers into a folder; returns the colours of the picture that stands for it.

    Raises:
        OSError, CaptureError: It cannot be written.
    """
    shown, still = np.zeros((0, 0, 3), np.uint8), film.count // 2 if film.still is None else film.still
    with ExitStack() as stack:
        put = {layer: stack.enter_context(_writer(film, folder / name)) for layer, name in film.names.items()}
        for n, (camera, time) in enumerate(zip(film.cameras, film.times, strict=True)):
            layers = render_layers(model, camera, time)
            picture = to_8_bits(layers[0])
            if n == still:
                shown = picture
            if "colour" in put:
                put["colour"](picture)
            if "depth" in put:
                assert film.depth is not None
                as_levels = depth_steps if film.format == "png" else depth_colours
                put["depth"](as_levels(planar_depth(camera, layers, film.depth), film.depth))
            progress((n + 1) / film.count, f"{n + 1} of {film.count} pictures")
    return shown


@contextmanager
def _writer(film: Film, path: Path) -> Iterator[Put]:
    """What takes one picture of a layer after the other."""
    if film.format == "mp4":
        with video_beside(path.with_name(f"{path.name}.mp4"), film.fps) as put:
            yield put
        return
    path.mkdir()
    numbers = iter(range(film.count))
    yield lambda picture: write_png(path / f"{next(numbers):06d}.png", picture)
