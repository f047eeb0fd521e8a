"""Clips of a wall that a flash or a lamp lights, by a camera with a rolling shutter, with known moments."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from devrf.capture.video.video_writer import write_video

WIDTH, HEIGHT = 64, 120
BLOCK_PX = 8  # of the wall's pattern
NOISE_LEVELS = 2.0


@dataclass(frozen=True)
class RollingShutter:
    """A camera: true time = offset_s + file time; row r of a frame opens at frame time + r / rows x readout.

    Readout and exposure together must be longer than a frame, or some flashes fall between two frames.
    """

    offset_s: float = 0.0
    fps: float = 30.0
    readout_s: float = 0.02
    exposure_s: float = 0.016
    seconds: float = 4.0  # length of its clip


def film_flashes(
    path: Path,
    camera: RollingShutter,
    flashes_s: Sequence[float],
    lamp_s: float | None = None,
    strength: float = 60.0,
    seed: int = 0,
) -> Path:
    """Write a clip.

    Args:
        path: The mp4 to write.
        camera: Its clock and shutter.
        flashes_s: True times of flashes, which light what is exposed at that moment.
        lamp_s: When a lamp is switched on: it lights what is exposed from then on, in proportion.
        strength: Levels of 255 that the light adds.
        seed: Of the wall and the noise.
    """
    rng = np.random.default_rng(seed)
    wall = np.kron(
        rng.integers(40, 140, (HEIGHT // BLOCK_PX, WIDTH // BLOCK_PX)), np.ones((BLOCK_PX, BLOCK_PX))
    )
    row = (np.arange(HEIGHT) + 0.5) / HEIGHT
    pictures = []
    for n in range(int(camera.seconds * camera.fps)):
        lit = exposed(camera, n, row, flashes_s, lamp_s)
        level = wall + strength * lit[:, None] + rng.normal(0, NOISE_LEVELS, wall.shape)
        pictures.append(np.repeat(np.clip(level, 0, 255).astype(np.uint8)[:, :, None], 3, axis=2))
    write_video(path, pictures, camera.fps)
    return path


def exposed(
    camera: RollingShutter,
    frame: int,
    row: np.ndarray,
    flashes_s: Sequence[float],
    lamp_s: float | None = None,
) -> np.ndarray:
    """How much of the light each row of a frame gets; `row` is its share of the height."""
    opens = camera.offset_s + frame / camera.fps + row * camera.readout_s
    lit = np.zeros(len(row))
    for at_s in flashes_s:
        lit += (opens <= at_s) & (at_s < opens + camera.exposure_s)
    if lamp_s is not None:
        lit += np.clip((opens + camera.exposure_s - lamp_s) / camera.exposure_s, 0, 1)
    return lit
