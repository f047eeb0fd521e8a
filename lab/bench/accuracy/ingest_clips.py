"""Clips for `bench ingest`: 1080p H.264 as phones write it, of textured surfaces that move, with noise."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.capture.video.video_writer import write_video

WIDTH, HEIGHT, FPS = 1920, 1080, 30
BIT_RATE = 16_000_000  # what phones write at 1080p30
NOISE_LEVELS = 2.5  # of luma, after a camera's own noise reduction
NOISE_PICTURES = 7  # repeated; no divisor of the distance between key pictures
OCTAVE_GAIN = 0.75  # of each octave of the texture over the one before: about as natural pictures fall off
SWING_PX, SWING_FRAMES = 250, 75


def film(path: Path, frames: int, bit_rate: int = BIT_RATE, seed: int = 0) -> Path:
    """Write such a clip, with a key picture a second; kept if it is there."""
    if not path.exists():
        rng = np.random.default_rng(seed)
        noise = rng.normal(0, NOISE_LEVELS, (NOISE_PICTURES, HEIGHT, WIDTH, 1)).astype(np.float32)
        noisy = (
            np.clip(clean + noise[n % NOISE_PICTURES], 0, 255).astype(np.uint8)
            for n, clean in enumerate(filmed(frames, seed))
        )
        partial = path.with_suffix(".part.mp4")
        write_video(partial, noisy, float(FPS), {"b": str(bit_rate), "preset": "veryfast", "g": str(FPS)})
        partial.rename(path)
    return path


def filmed(frames: int, seed: int = 0) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """The pictures before noise and coding."""
    rng = np.random.default_rng(seed)
    wall, subject = _texture(rng, WIDTH, HEIGHT), _texture(rng, 700, 500)
    for n in range(frames):
        picture = wall.copy()
        x = 600 + round(SWING_PX * np.sin(2 * np.pi * n / SWING_FRAMES))
        picture[300:800, x : x + 700] = subject
        yield picture


def _texture(rng: np.random.Generator, width: int, height: int) -> UInt8[np.ndarray, "height width 3"]:
    """Grey noise of all sizes and coarse colours, as surfaces have them: detail is in the lightness."""
    picture = np.zeros((height, width, 3), np.float32)
    gain, cells = 1.0, 4
    while cells <= width:
        size = (max(2, cells * height // width), cells)
        colours = rng.normal(size=(*size, 3)) if cells <= 64 else rng.normal(size=(*size, 1)).repeat(3, 2)
        picture += gain * cv2.resize(
            colours.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC
        )
        gain, cells = gain * OCTAVE_GAIN, 2 * cells
    return np.clip((picture - picture.mean()) / picture.std() * 45 + 120, 4, 250).astype(np.uint8)
