"""How soon the viewer shows a picture, and how many a second while a view moves: rows for docs/viewer.md.

    python -m benchmarks.viewer RUN [--device cpu] [--json FILE]     # RUN: a run folder with a trained model

Measured is all that this program does for a picture: rendering as for a view that moves (another camera and another
time for each), colours as bytes, depth, and viser's own encoding; the network and the page are not. The first picture
is that of a model that has been read, by kernels that have been compiled, in the size that the viewer begins with.
"""

import time

import numpy as np
import rich
import torch
import viser
from benchmarks.script import arguments, finish

from devrf.capture.camera import Camera
from devrf.capture.picture_files import to_8_bits
from devrf.pipelines.bench.rows import Row
from devrf.pipelines.device import resolve_device
from devrf.pipelines.viewer.site import CHUNK_CPU, settle
from devrf.pipelines.viewer.source import Loaded, load, look
from devrf.pipelines.viewer.view import View
from devrf.pipelines.viewer.visit import DEPTH_PIXELS, NOTHING_HIDES, QUALITY_MOVING
from devrf.reconstruct.film.paths import orbit
from devrf.reconstruct.film.span import film_cameras, film_lens
from devrf.reconstruct.model import render_layers
from devrf.reconstruct.refinement import Pace, at_size
from devrf.reconstruct.view_pictures import hiding_depth

WINDOW = (1280, 720)  # of the first picture
SIZES = {(200, 112): 5.0, (960, 540): 30.0}  # pictures a second that are wanted; the second of a GPU
FIRST_S = 2.0  # wanted
SECONDS, MOST, FEWEST = 8.0, 400, 4  # of measuring; pictures


def main() -> None:
    """Print the rows and write them."""
    chosen = arguments(__doc__, "run", device="auto")
    device = resolve_device(chosen.device)
    settle(device)
    begin = time.perf_counter()
    loaded = load(chosen.run, look(chosen.run), device, Loaded())
    if loaded.model is None or loaded.scene is None:
        raise SystemExit(f"{chosen.run}: no trained model; run the scene first")
    rows = [Row("viewer/model read", time.perf_counter() - begin, "s")]
    measure = _Measure(loaded, device)
    rows.append(Row("viewer/first picture", measure.first(), "s").at_most(FIRST_S))
    for (width, height), goal in SIZES.items():
        rate, worked_s = measure.rate(width, height)
        row = Row(f"viewer/pictures a second, {width}x{height}", rate, "1/s")
        rows.append(row.at_least(goal if device == "cuda" or width < 960 else None))
        rows.append(Row(f"viewer/processor time of a picture, {width}x{height}", worked_s, "s"))
    finish("viewer", rows, chosen.json, device=device)


class _Measure:
    """Pictures of a model, sent to nobody."""

    def __init__(self, loaded: Loaded, device: str) -> None:
        assert loaded.model is not None and loaded.scene is not None
        self.model, self.scene, self.device = loaded.model, loaded.scene, device
        if device == "cpu":
            self.model.chunk = CHUNK_CPU
        rich.get_console().quiet = True  # where viser speaks
        self.server = viser.ViserServer(host="127.0.0.1", port=8990, verbose=False)

    def first(self) -> float:
        """Seconds to the first picture, at the size with which the viewer begins."""
        view = View.first(self.scene)
        render_layers(self.model, view.camera(32, 32), self._moment(0.5))
        halvings = Pace().first(WINDOW[0] * WINDOW[1])
        begin = time.perf_counter()
        self._send(view.camera(*at_size(*WINDOW, halvings)), 0.0)
        return time.perf_counter() - begin

    def rate(self, width: int, height: int) -> tuple[float, float]:
        """Pictures a second while the camera and the time move, and the processor's seconds for one of them."""
        cameras = film_cameras(self.scene)
        path = orbit(cameras, self.scene.aabb, MOST, film_lens(cameras, 64_000))
        views = [View.through(camera, np.zeros(3)).camera(width, height) for camera in path]
        self._send(views[-1], 1.0)
        begin, worked, done = time.perf_counter(), time.process_time(), 0
        while done < MOST and (done < FEWEST or time.perf_counter() - begin < SECONDS):
            self._send(views[done], done / MOST)
            done += 1
        return done / (time.perf_counter() - begin), (time.process_time() - worked) / done

    def _send(self, camera: Camera, moment: float) -> None:
        rgb, depth, opacity = render_layers(self.model, camera, self._moment(moment), roughly=True)
        hides = hiding_depth(depth, opacity, camera, NOTHING_HIDES, DEPTH_PIXELS)
        self.server.scene.set_background_image(
            to_8_bits(rgb), "jpeg", jpeg_quality=QUALITY_MOVING, depth=hides
        )
        if self.device == "cuda":
            torch.cuda.synchronize()

    def _moment(self, moment: float) -> float | None:
        return None if self.model.motion is None else moment


if __name__ == "__main__":
    main()
