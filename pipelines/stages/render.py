"""Stage `render`: a film through space and time, `orbit.mp4`, and a still of it, `poster.png`."""

import time

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.photos.picture_files import write_png
from devrf.capture.system.durable import write_json
from devrf.pipelines.stage import StageContext
from devrf.reconstruct.film.times import film_seconds, film_times
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import orbit

# preset: most pictures, pictures per second, most pixels of a picture
SIZES = {"tiny": (120, 12.0, 64_000), "fast": (288, 24.0, 500_000), "reference": (480, 24.0, 1_000_000)}


def run(context: StageContext) -> None:
    """Write `orbit.mp4`, `poster.png` and `film.json`."""
    from devrf.reconstruct.film.film_maker import Film, make_film  # they need torch
    from devrf.reconstruct.film.subject import HIDDEN, clear_orbit, hidden, subject_of
    from devrf.reconstruct.storage.model_io import load_model

    scene = read_scene(context.run_dir / "scene").in_box_frame()
    most, fps, pixels = SIZES[context.config.preset]
    count = min(most, max(2, round(fps * film_seconds(scene))))
    cameras, times = film_cameras(scene), film_times(scene, count)
    lens = film_lens(cameras, pixels)
    model = load_model(context.run_dir, context.device)
    subject = subject_of(model, cameras)
    if subject is None:
        path, still, behind = orbit(cameras, scene.aabb, count, lens), count // 2, 0
    else:
        path = clear_orbit(model, cameras, scene.aabb, count, lens, subject)
        still = round(subject.telling * (count - 1))
        behind = sum(hidden(model, c, subject, t) >= HIDDEN for c, t in zip(path, times, strict=True))
    begin = time.perf_counter()
    film = Film(tuple(path), tuple(times), fps, {"colour": "orbit"}, still=still)
    write_png(context.out / "poster.png", make_film(film, model, context.out, context.progress))
    about = {
        "frames": count,
        "fps": fps,
        "width": path[0].width,
        "height": path[0].height,
        "times": times,
        "still": still,
        "hidden": behind,
        "seconds": round(time.perf_counter() - begin, 3),
    }
    write_json(context.out / "film.json", about)
