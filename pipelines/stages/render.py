"""Stage `render`: a film through space and time, `orbit.mp4`, and a still of it, `poster.png`."""

import json
import time

from devrf.capture.formats.scene_files import read_scene
from devrf.capture.picture_files import to_8_bits, write_png
from devrf.capture.video_writer import video_beside
from devrf.pipelines.stage import StageContext
from devrf.pipelines.trained_model import load_renderer
from devrf.reconstruct.film.paths import orbit
from devrf.reconstruct.film.span import film_cameras, film_lens
from devrf.reconstruct.film.times import film_times

# preset: pictures, pictures per second, most pixels of a picture
SIZES = {"tiny": (48, 12.0, 64_000), "fast": (96, 24.0, 500_000), "reference": (192, 24.0, 1_000_000)}
POSTER = 0.5  # of the film: mid-motion


def run(context: StageContext) -> None:
    """Write `orbit.mp4`, `poster.png` and `film.json`."""
    scene = read_scene(context.run_dir / "scene").in_box_frame()
    count, fps, pixels = SIZES[context.config.preset]
    cameras = film_cameras(scene)
    path = orbit(cameras, scene.aabb, count, film_lens(cameras, pixels))
    times = film_times(scene, count)
    render = load_renderer(context.run_dir, context.device)
    begin = time.perf_counter()
    with video_beside(context.out / "orbit.mp4", fps) as put:
        for n in range(count):
            picture = to_8_bits(render(path[n], times[n]))
            put(picture)
            if n == int(POSTER * count):
                write_png(context.out / "poster.png", picture)
            context.progress((n + 1) / count, f"{n + 1} of {count} pictures")
    film = {
        "frames": count,
        "fps": fps,
        "width": path[0].width,
        "height": path[0].height,
        "times": times,
        "seconds": round(time.perf_counter() - begin, 3),
    }
    (context.out / "film.json").write_text(json.dumps(film, indent=1) + "\n")
