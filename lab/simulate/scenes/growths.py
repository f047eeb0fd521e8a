"""A model that bends: a flower that opens.

World and limits as in `machines`. Stems and petals are tubes around lines that bend; along them lengths are kept.
"""

from collections.abc import Callable

import numpy as np

from devrf.lab.simulate.scenes.catalogue import Paint
from devrf.lab.simulate.scenes.shapes import (
    Model,
    Part,
    Pose,
    bent,
    ease,
    rigid,
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
STEM_LENGTH = 1.15
RINGS = 40


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


def _soft(
    rng: np.random.Generator, rings: Callable[[float], np.ndarray], paint: Paint, coarse: float = 0.8
) -> Part:
    return Part(tube_mesh(rng, rings(0.0), paint, coarse), lambda time: rings(time).reshape(-1, 3))
