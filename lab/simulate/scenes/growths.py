"""Models that bend: a flower that opens, and a hand in a glove that closes.

World and limits as in `simulate_machines`. Stems, petals and fingers are tubes around lines that bend; along
them lengths are kept.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from devrf.lab.simulate.scenes.catalogue import Paint
from devrf.lab.simulate.scenes.shapes import (
    Model,
    Part,
    Pose,
    bent,
    ease,
    rigid,
    rounded_box,
    shift,
    tube,
    tube_mesh,
    turn,
    turned,
)

GREEN = Paint((75, 140, 65), 55.0)
LEAF = Paint((60, 120, 80), 60.0)
PETAL = (Paint((225, 110, 130), 60.0), Paint((225, 150, 70), 60.0))
HEART = Paint((205, 165, 55), 60.0)
CLAY = Paint((175, 100, 70), 50.0)
SOIL = Paint((80, 62, 50), 35.0)
LEATHER = Paint((175, 125, 80), 65.0)
FINGERS = (
    Paint((180, 80, 70), 60.0),
    Paint((190, 150, 60), 60.0),
    Paint((80, 145, 95), 60.0),
    Paint((75, 115, 180), 60.0),
    Paint((150, 95, 165), 60.0),
)
CUFF = Paint((70, 85, 120), 55.0)
STEM_LENGTH = 1.15
RINGS = 40
HAND_SIZE = 1.2  # relative to the numbers in `glove`


def flower(rng: np.random.Generator, motion_scale: float) -> Model:
    """A flower in a pot: the stem bends over while ten petals and two leaves open."""
    s = np.linspace(0, 1, RINGS)

    def stem(time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        lean = 0.1 + motion_scale * 0.75 * ease(time)
        spine, side, other = bent(STEM_LENGTH, lean * s**1.5)
        return spine + [-0.3, 0, -0.62], side, other

    def stem_rings(time: float) -> np.ndarray:
        return tube(*stem(time), 0.05 - 0.012 * s, 0.05 - 0.012 * s)

    def at(place: int, time: float) -> Pose:
        """The frame at a ring of the stem, z along it."""
        spine, side, other = stem(time)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([side[place], other[place], np.cross(side[place], other[place])], 1)
        pose[:3, 3] = spine[place]
        return pose

    pot = turned(
        rng,
        CLAY,
        [(0, -1.15), (0.3, -1.15)],
        [(0.3, -1.15), (0.4, -0.75)],
        [(0.4, -0.75), (0.46, -0.75)],
        [(0.46, -0.75), (0.48, -0.58)],
        [(0.48, -0.58), (0.42, -0.58)],
        [(0.42, -0.58), (0.41, -0.64)],
    )
    soil = turned(
        rng, SOIL, [(0, -0.8), (0.41, -0.75)], [(0.41, -0.75), (0.405, -0.64), (0.2, -0.62), (0, -0.61)]
    )
    rise = np.linspace(-0.5, np.pi / 2, 12)
    dome = turned(
        rng,
        HEART,
        [(0, -0.07), (0.17, -0.07)],
        [(0.19 * float(np.cos(a)), 0.12 * float(np.sin(a))) for a in rise],
    )
    parts = [rigid(pot, shift(-0.3, 0, 0)), rigid(soil, shift(-0.3, 0, 0))]
    parts.append(_soft(rng, stem_rings, GREEN))
    parts.append(rigid(dome, lambda time: at(-1, time) @ shift(0, 0, 0.03)))
    for layer, (count, length, width, closed, opened) in enumerate(
        ((5, 0.5, 0.17, 0.12, 0.85), (5, 0.6, 0.2, 0.35, 1.35))
    ):
        for k in range(count):
            about = turn("z", 360 / count * (k + 0.5 * layer))

            def rings(
                time: float, about=about, length=length, width=width, closed=closed, opened=opened
            ) -> np.ndarray:
                lean = closed + motion_scale * (opened - closed) * ease(time)
                curl = -0.5 + motion_scale * 0.9 * ease(time)  # bent inward at first, outward at last
                return _leaf(at(-1, time) @ about @ shift(0.12, 0, 0), length, width, lean + curl * (s - 0.2))

            parts.append(_soft(rng, rings, PETAL[layer], coarse=0.7))
    for place, about_deg, size in ((12, 75, 0.62), (18, -80, 0.5)):
        about = turn("z", about_deg)

        def leaf(time: float, place=place, about=about, size=size) -> np.ndarray:
            lean = 0.45 + motion_scale * 0.55 * ease(time)
            return _leaf(at(place, time) @ about @ shift(0.02, 0, 0), size, 0.13, lean + 0.5 * s)

        parts.append(_soft(rng, leaf, LEAF, coarse=0.7))
    return tuple(parts)


def _leaf(pose: Pose, length: float, width: float, angle: np.ndarray) -> np.ndarray:
    """A petal or leaf: a flat tube, pointed at both ends, hollow like a spoon."""
    s = np.linspace(0, 1, len(angle))
    outline = np.sin(np.pi * s**0.75) ** 0.8 * (1 - 0.25 * s) + 0.02
    spine, side, other = bent(length, angle)
    # In this order the tube's `side` is the thin way: across the petal is y.
    rings = tube(spine, side, other, 0.012 + 0.012 * outline, width * outline)
    hollow = 0.9 * (rings @ [0, 1, 0]) ** 2 / width
    rings = rings - hollow[..., None] * side[:, None]
    return rings @ pose[:3, :3].T + pose[:3, 3]


def glove(rng: np.random.Generator, motion_scale: float) -> Model:
    """A hand in a glove: four fingers and a thumb curl from a stretched hand to a fist."""
    profile = (
        [(0.0, -0.36), (0.3, -0.36)],
        [(0.3, -0.36), (0.34, -0.3), (0.3, -0.1), (0.27, 0.0)],
        [(0.27, 0.0), (0.0, 0.02)],
    )
    cuff = turned(rng, CUFF, *profile)
    oval = np.diag([1.0, 0.62, 1.0, 1.0])
    parts = [
        rigid(rounded_box(rng, (0.86, 0.31, 0.84), LEATHER, 0.14), shift(0, 0, -0.32)),
        rigid(cuff, shift(0, 0, -0.68) @ oval),
    ]
    for k, (x, top, length) in enumerate(
        ((-0.325, 0.02, 0.66), (-0.11, 0.06, 0.8), (0.11, 0.06, 0.86), (0.325, 0.03, 0.76))
    ):
        root = shift(x, 0, top - 0.08) @ turn("y", 9 * x / 0.325) @ turn("z", -90)  # curls towards -y
        parts.append(
            _soft(rng, _finger(root, length, 0.108, (78, 85, 45), 0.07 * k, motion_scale), FINGERS[k])
        )
    root = shift(0.36, -0.02, -0.52) @ turn("y", 52) @ turn("z", -140)
    parts.append(_soft(rng, _finger(root, 0.68, 0.12, (20, 40, 55), 0.2, motion_scale), FINGERS[4]))
    return tuple(_grown(part) for part in parts)


def _grown(part: Part) -> Part:
    """The hand was measured at a smaller size."""
    return Part(
        replace(part.rest, vertices=HAND_SIZE * part.rest.vertices),
        lambda time: HAND_SIZE * part.vertices_at(time),
    )


def _finger(
    root: Pose, length: float, radius: float, curl_deg: tuple[int, ...], start: float, motion_scale: float
) -> Callable[[float], np.ndarray]:
    """A finger that bends at three joints, thicker there, beginning at the time `start`."""
    s = np.linspace(0, 1, 56)
    joints = (0.14, 0.48, 0.75)
    end = np.sqrt(np.clip(1 - ((s - 1 + radius / length) / (radius / length)).clip(0) ** 2, 0, 1))
    bulge = 1 + 0.07 * sum(np.exp(-(((s - j) / 0.06) ** 2)) for j in joints) - 0.18 * s
    r = radius * end * bulge
    steps = [0.5 + 0.5 * np.sin(np.pi * np.clip((s - j) / 0.26, -0.5, 0.5)) for j in joints]

    def rings(time: float) -> np.ndarray:
        e = motion_scale * ease(time, start, 0.8 + start)
        angle = np.radians(sum((4 + e * deg) * step for deg, step in zip(curl_deg, steps, strict=True)))
        return tube(*bent(length, angle), r, r) @ root[:3, :3].T + root[:3, 3]

    return rings


def _soft(
    rng: np.random.Generator, rings: Callable[[float], np.ndarray], paint: Paint, coarse: float = 0.8
) -> Part:
    return Part(tube_mesh(rng, rings(0.0), paint, coarse), lambda time: rings(time).reshape(-1, 3))
