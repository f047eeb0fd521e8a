"""Films of the documentation, from finished runs.

    python docs/site/hero.py RUN             # of the example: docs/film.webp and docs/example.jpg
    python docs/site/hero.py RUN FILE.webp   # of any run: what its test camera filmed, and the same view rendered

The first has side by side what the witness filmed, which is not trained on; the same moments rendered from where no
camera stood; the same with trails of what moves.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

import devrf
from devrf.capture.video.reader import VideoReader

DOCS = Path(__file__).resolve().parents[1]
EXAMPLE = DOCS.parent / "examples" / "workshop"
SIZE, GAP = (320, 180), 6
FPS = 12  # at half speed
WAYS, TRAIL = 500, 16  # points whose ways are drawn, over so many moments
MOVES = 0.03  # of the scene's size: what goes less far is not drawn
HIDDEN = 0.03  # of its depth, by which a point may lie behind the surface that is drawn


def main(run: Path, folder: Path = DOCS, pictures: int = 60) -> None:
    """Write film.webp and example.jpg into a folder."""
    scene = devrf.load(run, device="cpu")
    true, ways = witness(), Ways(scene)
    times = np.linspace(scene.times_s[0], scene.times_s[-1], pictures)
    film = []
    for n, time_s in enumerate(times):
        turn = 1 - np.cos(2 * np.pi * n / pictures)  # there and back
        sides, share = (("cam0", "cam1"), turn) if turn < 1 else (("cam1", "cam2"), turn - 1)
        camera = scene.between(*sides, float(share)).scaled(SIZE[0] / scene.cameras["cam1"].width)
        view = scene.render(camera, float(time_s))
        seen = levels(view.colour)
        film.append(beside(true(time_s), seen, ways.drawn(seen, view.depth, camera, float(time_s))))
    save(film, folder / "film.webp", FPS, 62)
    middle = float(scene.times_s[round(0.62 * len(scene.times_s))])
    rendered = levels(scene.render("witness", middle).colour)
    with VideoReader(EXAMPLE / "static.mp4") as reader:
        sweep = next(frame.rgb for frame in reader if frame.index == 14)
    Image.fromarray(beside(sweep, true(middle), rendered)).save(
        folder / "example.jpg", quality=84, optimize=True
    )


def compared(run: Path, file: Path) -> None:
    """A film of the first test camera's views, as stage `evaluate` left them, at half speed or so."""
    folder = next(path for path in sorted((run / "evaluate" / "views").iterdir()) if path.name != "static")
    views = [
        (path, path.with_name(path.name.replace("_true", "_rendered"))) for path in folder.glob("*_true.png")
    ]
    pairs = [
        [np.asarray(Image.open(path)) for path in pair] for pair in sorted(views)[:: max(1, len(views) // 40)]
    ]
    gap = np.full((pairs[0][0].shape[0], GAP, 3), 255, np.uint8)
    save([np.concatenate([true, gap, rendered], axis=1) for true, rendered in pairs], file, 10, 68)


def save(pictures: list[np.ndarray], file: Path, fps: int, quality: int) -> None:
    """As a film that begins again."""
    first, *rest = (Image.fromarray(picture) for picture in pictures)
    first.save(
        file,
        save_all=True,
        append_images=rest,
        duration=round(1000 / fps),
        loop=0,
        quality=quality,
        method=6,
    )


def witness() -> Callable[[float], np.ndarray]:
    """What the witness shows at a time, by its true clock."""
    truth = json.loads((EXAMPLE / "ground_truth.json").read_text())["cams"]["witness"]
    with VideoReader(EXAMPLE / "witness.mp4") as reader:
        frames = [(truth["offset_s"] + (1 + 1e-6 * truth["drift_ppm"]) * f.time_s, f.rgb) for f in reader]
    return lambda time_s: min(frames, key=lambda frame: abs(frame[0] - time_s))[1]


class Ways:
    """Where points of the surface that move have come from."""

    def __init__(self, scene: devrf.Reconstruction) -> None:
        self.times_s = np.array(scene.times_s)
        surface = scene.points(self.times_s[0]).xyz
        some = np.random.default_rng(0).choice(len(surface), min(len(surface), 20 * WAYS), replace=False)
        ways = scene.tracks(surface[some], float(self.times_s[0]))
        far = np.ptp(ways, axis=0).max(axis=-1) > MOVES * np.ptp(surface, axis=0).max()
        self.ways = ways[:, far][:, :WAYS]
        hue = np.linspace(0, 179, self.ways.shape[1]).astype(np.uint8)
        hue = hue[np.argsort(np.argsort(self.ways[0, :, 2]))]  # by height
        row = np.stack([hue, np.full_like(hue, 255), np.full_like(hue, 255)], -1)
        self.colours = cv2.cvtColor(row[None], cv2.COLOR_HSV2RGB)[0]

    def drawn(
        self, picture: np.ndarray, depth: np.ndarray, camera: devrf.Camera, time_s: float
    ) -> np.ndarray:
        """Over the darkened picture, where nothing is before them."""
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
        out = np.repeat((0.55 * grey).astype(np.uint8)[..., None], 3, axis=-1)
        now = int(np.argmin(np.abs(self.times_s - time_s)))
        here = self.ways[now] @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
        courses = np.stack([camera.project(at) for at in self.ways[max(0, now - TRAIL) : now + 1]])
        for course, z, colour in zip(courses.swapaxes(0, 1), here[:, 2], self.colours, strict=True):
            x, y = np.round(course[-1]).astype(int) if np.isfinite(course).all() else (-1, -1)
            if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]):
                continue
            if depth[y, x] and z > depth[y, x] * (1 + HIDDEN):
                continue
            line = np.round(16 * course).astype(np.int32)
            cv2.polylines(out, [line], False, colour.tolist(), 1, cv2.LINE_AA, 4)
        return out


def levels(colour: np.ndarray) -> np.ndarray:
    """Of [0, 1], as pictures have them."""
    return (255 * np.clip(colour, 0, 1)).astype(np.uint8)


def beside(*pictures: np.ndarray) -> np.ndarray:
    """In a row, at the size of the film."""
    row = [cv2.resize(picture, SIZE, interpolation=cv2.INTER_AREA) for picture in pictures]
    gap = np.full((SIZE[1], GAP, 3), 255, np.uint8)
    return np.concatenate([part for picture in row for part in (gap, picture)][1:], axis=1)


if __name__ == "__main__":
    if len(sys.argv) > 2:
        compared(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        main(Path(sys.argv[1]))
