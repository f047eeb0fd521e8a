"""Stage `render`: a film through space and time, `orbit.mp4`, and a still of it, `poster.png`."""

import json
import time
from collections.abc import Iterator

import cv2
import numpy as np

from devrf.capture.errors import ReconstructError
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.video_writer import write_video
from devrf.pipelines.stage import StageContext
from devrf.pipelines.trained_model import load_renderer
from devrf.reconstruct.film import film_cameras, film_frames, film_times, orbit

# preset: pictures, pictures per second, most pixels of a picture
SIZES = {"tiny": (48, 12.0, 64_000), "fast": (96, 24.0, 500_000), "reference": (192, 24.0, 1_000_000)}
POSTER = 0.5  # of the film: mid-motion


def run(context: StageContext) -> None:
    """Write `orbit.mp4`, `poster.png` and `film.json`."""
    scene = read_scene(context.run_dir / "scene").in_box_frame()
    count, fps, pixels = SIZES[context.config.preset]
    path = orbit(film_cameras(scene), scene.aabb, count, pixels)
    times = film_times(scene, count)
    render = load_renderer(context.run_dir, context.device, context.allowance.at_once)
    begin = time.perf_counter()

    def frames() -> Iterator[np.ndarray]:
        for n, picture in enumerate(film_frames(render, path, times)):
            if n == int(POSTER * count):
                poster = context.out / "poster.png"
                if not cv2.imwrite(str(poster), picture[..., ::-1]):
                    raise ReconstructError(f"{poster}: cannot be written; check free space")
            context.progress((n + 1) / count, f"{n + 1} of {count} pictures")
            yield picture

    write_video(context.out / "orbit.mp4", frames(), fps)
    film = {
        "frames": count,
        "fps": fps,
        "width": path[0].width,
        "height": path[0].height,
        "times": times,
        "seconds": round(time.perf_counter() - begin, 3),
    }
    (context.out / "film.json").write_text(json.dumps(film, indent=1) + "\n")
