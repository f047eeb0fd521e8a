"""Mattes by a screen's colour against exact ones: models before green and blue screens; IoU, mean and worst picture.

    python -m benchmarks.mattes [--frames 20] [--size 320x240]

Pictures are JPEG of quality 85, screens are unevenly lit. Models have all colours: what
they share with a screen is lost to it. `eroded` is what a matte would reach that is exact but for a pixel all around.
"""

import tempfile
from pathlib import Path

import cv2
import numpy as np
from benchmarks.script import arguments
from tests.capture.passing import simulate_passing

from devrf.capture.mattes.make import CameraMattes, Clip, chroma_mattes
from devrf.capture.photos.picture_files import read_pixels

SCREENS = {"green screen": (30, 160, 70), "blue screen": (20, 60, 190)}


def main() -> None:
    """Print the table."""
    chosen = arguments(__doc__, frames=20, size="320x240")
    width, height = (int(side) for side in chosen.size.split("x"))
    print("| model | screen | IoU | worst picture | seconds a picture | eroded |\n|---|---|---|---|---|---|")
    for seed, scene in enumerate(("robot", "arm", "flower"), 11):
        pictures, mattes = simulate_passing(scene, chosen.frames, (width, height), seed)
        light = 0.6 + 0.4 * np.sin(np.linspace(0, 3, width))[:, None]
        alpha = mattes[..., None]
        for name, colour in SCREENS.items():
            before = alpha * pictures + (1 - alpha) * np.array(colour) * light
            _row(scene, name, before.astype(np.uint8), mattes)


def _row(scene: str, screen: str, pictures: np.ndarray, mattes: np.ndarray) -> None:
    start = cv2.getTickCount()
    with tempfile.TemporaryDirectory() as folder:
        made = _made(pictures, Path(folder))
        seconds = (cv2.getTickCount() - start) / cv2.getTickFrequency() / len(pictures)
        ours = np.stack([read_pixels(file)[..., 0] > 127 for file in made.files])
    true = mattes > 0.5
    overlap = [(a & b).sum() / (a | b).sum() for a, b in zip(ours, true, strict=True)]
    cross = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    inner = [cv2.erode(t.astype(np.uint8), cross, borderType=cv2.BORDER_REPLICATE) for t in true]
    exact = np.mean([i.sum() / t.sum() for i, t in zip(inner, true, strict=True)])
    print(
        f"| {scene} | {screen} | {np.mean(overlap):.3f} | {min(overlap):.3f} | {seconds:.2f} | {exact:.3f} |"
    )


def _made(pictures: np.ndarray, folder: Path) -> CameraMattes:
    files = [folder / f"{n:06d}.jpg" for n in range(len(pictures))]
    for file, picture in zip(files, pictures, strict=True):
        cv2.imwrite(str(file), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    size = (pictures.shape[2], pictures.shape[1])
    clip = Clip("cam0", tuple(files), {n: None for n in range(len(files))}, (size,) * len(files))
    return chroma_mattes(clip, None, folder / "out")


if __name__ == "__main__":
    main()
