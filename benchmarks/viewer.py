"""How soon the viewer shows a picture, and how many a second while a visitor and the time move.

    python -m benchmarks.viewer RUN [--device cpu] [--json rows.json]

Measured is all that this program does for a picture: rendering as for a view that moves (another camera and another
time for each), colours as bytes, and viser's own encoding; the network and the page are not. The first picture
is that of a model that has been read, by kernels that have been compiled, in the size that the viewer begins with.
"""

import time

import rich
import torch
import viser
from benchmarks.script import arguments, finish

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import to_8_bits
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.inputs.device import resolve_device
from devrf.pipelines.viewer.progressive import FIRST, at_most
from devrf.pipelines.viewer.server import QUALITY_MOVING
from devrf.pipelines.viewer.source import Loaded, load, look
from devrf.pipelines.viewer.views import first_camera
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import orbit
from devrf.reconstruct.rendering.model import render_layers

SIZES = {(200, 112): 5.0, (960, 540): 30.0}  # pictures a second that are wanted; the second of a GPU
FIRST_S = 2.0  # wanted
SECONDS, MOST, FEWEST = 8.0, 400, 4  # of measuring; pictures


def main() -> None:
    """Print the rows and write them."""
    chosen = arguments(__doc__, "run", device="auto")
    device = resolve_device(chosen.device)
    if device == "cpu":
        torch.set_num_threads(1)  # as the viewer does
    begin = time.perf_counter()
    loaded = load(chosen.run, look(chosen.run), device)
    if loaded.model is None or loaded.scene is None:
        raise SystemExit(f"{chosen.run}: no trained model; run the scene first")
    rows = [Row("viewer/model read", time.perf_counter() - begin, "s"), *_measured(loaded, device)]
    finish("viewer", rows, chosen.json, device=device)


def _measured(loaded: Loaded, device: str) -> list[Row]:
    """Rows of pictures that are sent to nobody."""
    model, scene = loaded.model, loaded.scene
    assert model is not None and scene is not None
    rich.get_console().quiet = True  # where viser speaks
    server = viser.ViserServer(host="127.0.0.1", port=8990, verbose=False)

    def send(camera: Camera, moment: float) -> None:
        shown = None if model.motion is None else moment
        picture = to_8_bits(render_layers(model, camera, shown, roughly=True)[0])
        server.scene.set_background_image(picture, "jpeg", jpeg_quality=QUALITY_MOVING)
        if device == "cuda":
            torch.cuda.synchronize()

    first = first_camera(scene)
    send(first.scaled(0.1), 0.5)
    begin = time.perf_counter()
    send(first.scaled(at_most(first.width, first.height, FIRST)[0] / first.width), 0.0)
    rows = [Row("viewer/first picture", time.perf_counter() - begin, "s").at_most(FIRST_S)]
    cameras = film_cameras(scene)
    for (width, height), goal in SIZES.items():
        views = orbit(cameras, scene.aabb, MOST, film_lens(cameras, size=(width, height)))
        send(views[-1], 1.0)
        begin, worked, done = time.perf_counter(), time.process_time(), 0
        while done < MOST and (done < FEWEST or time.perf_counter() - begin < SECONDS):
            send(views[done], done / MOST)
            done += 1
        rate, worked_s = done / (time.perf_counter() - begin), (time.process_time() - worked) / done
        row = Row(f"viewer/pictures a second, {width}x{height}", rate, "1/s")
        rows.append(row.at_least(goal if device == "cuda" or width < 960 else None))
        rows.append(Row(f"viewer/processor time of a picture, {width}x{height}", worked_s, "s"))
    return rows


if __name__ == "__main__":
    main()
