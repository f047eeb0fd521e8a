"""Pictures under light that is known, and colour profiles."""

import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.camera import Camera
from devrf.capture.colour.correction import Look
from devrf.capture.colour.light_course import LightCourse, LightMeter
from devrf.capture.colour.srgb import srgb_from_linear
from devrf.capture.scene import PosedFrame

Pictures = list[UInt8[np.ndarray, "h w 3"]]


def frame_of(path: Path, width: int, height: int, look: Look | None = None) -> PosedFrame:
    """A picture at rest of a camera at the origin."""
    K = np.array([[50.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    camera = Camera(width, height, K, np.eye(4)[:3])
    return PosedFrame(path, camera, "static", 0, None, None, "train", look=look)


def room(rng: np.random.Generator) -> Float[np.ndarray, "120 160 3"]:
    """A wall of patches of many colours, linear light from 0.04 to 0.4."""
    return rng.uniform(0.04, 0.4, (12, 16, 3)).repeat(10, axis=0).repeat(10, axis=1)


def levels_of(scene: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """Linear light in sRGB."""
    return (255 * srgb_from_linear(scene)).round().astype(np.uint8)


def film_of_room(light: Float[np.ndarray, "n rows 3"], square: int = 40) -> Pictures:
    """The room under changing light that differs by rows, noise of one level, with a bright square that moves."""
    rng = np.random.default_rng(0)
    wall, pictures = room(rng), []
    for n, rows in enumerate(light):
        scene, x = wall.copy(), (7 * n) % 100
        scene[30:90, x : x + square] = 0.6
        linear = scene * rows.repeat(120 // len(rows), axis=0)[:, None]
        levels = 255 * srgb_from_linear(np.clip(linear, 0, 1)) + rng.standard_normal(scene.shape)
        pictures.append(np.clip(levels, 0, 255).round().astype(np.uint8))
    return pictures


def fixed(*values: float) -> bytes:
    """Numbers as profiles have them (s15Fixed16Number)."""
    return b"".join(struct.pack(">i", round(value * 65536)) for value in values)


def icc_profile(name: str, columns: Float[np.ndarray, "3 3"], curve: bytes) -> bytes:
    """An ICC profile of a matrix and one curve for all colours (ICC.1:2022, 7.2, 7.3, 9 and 10).

    Args:
        name: Its description.
        columns: XYZ of red, green and blue, adapted to D50.
        curve: A curve as profiles have it.
    """
    words = struct.pack(">4sIII2s2sII", b"mluc", 0, 1, 12, b"en", b"US", 2 * len(name), 28)
    white = b"XYZ \0\0\0\0" + fixed(0.9642, 1.0, 0.8249)
    tags = {b"desc": words + name.encode("utf-16-be"), b"wtpt": white}
    tags |= {
        k: b"XYZ \0\0\0\0" + fixed(*c) for k, c in zip((b"rXYZ", b"gXYZ", b"bXYZ"), columns.T, strict=True)
    }
    tags |= dict.fromkeys((b"rTRC", b"gTRC", b"bTRC"), curve)
    table, body, at = b"", b"", 132 + 12 * len(tags)
    for key, value in tags.items():
        table += struct.pack(">4sII", key, at + len(body), len(value))
        body += value + b"\0" * (-len(value) % 4)
    size = at + len(body)
    head = struct.pack(
        ">I4sI4s4s4s6H4s", size, b"", 0x04300000, b"mntr", b"RGB ", b"XYZ ", 2026, 1, 1, 0, 0, 0, b"acsp"
    )
    return (
        head
        + bytes(28)
        + fixed(0.9642, 1.0, 0.8249)
        + bytes(48)
        + struct.pack(">I", len(tags))
        + table
        + body
    )


def course_of(pictures: Pictures, time_s: Float[np.ndarray, " n"] | None = None) -> LightCourse:
    """Their light as ingest measures it; 25 a second, or at these times."""
    meter = LightMeter()
    for n, picture in enumerate(pictures):
        meter.add(n, n / 25 if time_s is None else float(time_s[n]), picture)
    return meter.course()
