"""Pictures a second of films against rendering alone: what encoding and keeping pictures cost.

    python -m benchmarks.film SCENE [--preset tiny] [--set "output=run …"] [--device cpu] [--json FILE]

SCENE is a run that is finished. Rendering alone and a film of the same cameras, times and size take turns; both begin
without surroundings that are remembered. A camera that stands is that of `render_fps` in evaluate/metrics.json (a
test camera, else the first); its surroundings are rendered once, in the first picture, which neither number counts as
evaluate does not. On an orbit every picture has surroundings of its own. Processor time is that of the whole process:
where a machine does other work besides, it says more than the wall clock.
"""

import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from benchmarks.script import arguments, finish

from devrf.capture.formats.scene_files import read_scene
from devrf.capture.progress import no_progress
from devrf.lab.bench.bench_rows import Row
from devrf.pipelines.cli_options import configured
from devrf.pipelines.device import resolve_device
from devrf.pipelines.film.asked import Asked
from devrf.pipelines.film.draw import Drawer
from devrf.pipelines.film.kept import Kept
from devrf.pipelines.film.make import make
from devrf.pipelines.film.plan import Film, planned
from devrf.pipelines.stages.render import SIZES
from devrf.pipelines.trained_model import load_trained
from devrf.reconstruct.film.layers import DepthScale
from devrf.reconstruct.model import DynamicModel, render_view

GOAL = 0.9
ROUNDS = 2


def main() -> None:
    """Print the table; write its rows where asked to."""
    chosen = arguments(__doc__, "scene", preset=None, set=None, device="auto", pictures=24)
    overrides = None if chosen.set is None else chosen.set.split()
    config, scene_dir = configured(chosen.scene, chosen.preset, overrides, check_files=False)
    run_dir = config.run_dir(scene_dir)
    world = read_scene(run_dir / "scene")
    model = load_trained(run_dir, resolve_device(chosen.device))
    test = [f.camera_name for f in world.dynamic if f.split == "test"] or [world.dynamic[0].camera_name]
    rows = []
    for path in (f"still:{test[0]}", "orbit"):
        film = planned(
            Asked(path=path, fps=10.0, seconds=chosen.pictures / 10), world, True, SIZES[config.preset][2]
        )
        rows += _rows(path.partition(":")[0], film, model)
    told = json.loads((run_dir / "evaluate" / "metrics.json").read_text())["render_fps"]
    rows.append(Row("film/still/render_fps of evaluate", told, "pictures/s"))
    finish("film", rows, chosen.json, pictures=chosen.pictures)


def _rows(name: str, film: Film, model: DynamicModel) -> list[Row]:
    """Rendering alone and filming take turns."""
    alone, filmed = zip(*(_round(film, model) for _ in range(ROUNDS)), strict=True)
    (wall, cpu), (film_wall, film_cpu) = (np.median(np.array(part), axis=0) for part in (alone, filmed))
    share = float(np.median([a[0] / f[0] for a, f in zip(alone, filmed, strict=True)]))
    camera = film.cameras[0]
    where = f"film/{name} {camera.width}x{camera.height}"
    return [
        Row(f"{where}/rendering alone", float(1 / wall), "pictures/s"),
        Row(f"{where}/film", float(1 / film_wall), "pictures/s"),
        Row(f"{where}/film of rendering", share, "").at_least(GOAL),
        Row(f"{where}/processor time, film of rendering", float(film_cpu / cpu), ""),
    ]


def _round(film: Film, model: DynamicModel) -> tuple[tuple[float, float], tuple[float, float]]:
    """Seconds and processor seconds a picture, alone and filmed."""

    def alone() -> None:
        for camera, at in zip(film.cameras, film.times, strict=True):
            render_view(model, camera, at)

    depth = DepthScale.of(film.cameras, film.scene.aabb, model.rest.near, 1.0, False)
    with tempfile.TemporaryDirectory() as folder:
        kept = Kept(Path(folder) / "film")
        kept.begin("benchmark")
        drawer = Drawer(film, model, None, depth)
        return _timed(film, model, alone), _timed(film, model, lambda: make(drawer, kept, no_progress))


def _timed(film: Film, model: DynamicModel, work: Callable[[], object]) -> tuple[float, float]:
    model.forget()
    if film.cameras[0] is film.cameras[-1]:  # its surroundings are found in a picture that does not count
        render_view(model, film.cameras[0], film.times[0])
    wall, cpu = time.perf_counter(), time.process_time()
    work()
    return (time.perf_counter() - wall) / film.count, (time.process_time() - cpu) / film.count


if __name__ == "__main__":
    main()
