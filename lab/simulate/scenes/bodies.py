"""Objects of several bodies, each with a motion of its own.

Blocks that push each other, a plant, an aircraft that leaves and comes back, a rod. Persons are in `people.py`.

Each stands on the platform of the room of `scenes`. `motion_scale` multiplies every way and every angle; the times
below are seconds since the motion begins, at a motion_speed of 1.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from devrf.lab.simulate.scenes.catalogue import PLATFORM_M, WOOD, Mesh, MovingObject, Paint, box
from devrf.lab.simulate.scenes.growths import flower
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import (
    Number,
    Part,
    Pose,
    ball,
    ease,
    rigid,
    rounded_box,
    shift,
    turn,
    turned,
)

RED, BLUE, SAND = Paint((190, 75, 60), 75.0), Paint((70, 110, 175), 75.0), Paint((200, 165, 90), 80.0)
TABLE_TOP_M = 0.62
OUT_AND_BACK_S = 2.0
FAR_M = 1.5
FINE = 3.0  # shapes are made this much larger and shrunk: their textures are made for things of two metres


def blocks(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A block slides against another and pushes it, and that one sets a ball rolling that leant against it."""
    size, ball_m, gap_m, way_m = np.array([0.24, 0.22, 0.26]), 0.12, 0.06, 0.24
    scale = options.motion_scale

    def first(time: float) -> Pose:
        return shift(0.02, -0.4 + way_m * scale * ease(time, 0.0, 1.4), TABLE_TOP_M + size[2] / 2)

    def pushed_m(time: float) -> float:
        return max(way_m * scale * ease(time, 0.0, 1.4) - gap_m, 0.0)

    def second(time: float) -> Pose:
        return shift(0.0, -0.4 + size[1] + gap_m + pushed_m(time), TABLE_TOP_M + size[2] / 2)

    def rolling(time: float) -> Pose:
        rolled_m = max(pushed_m(time), 0.34 * scale * ease(time, 0.45, 2.2))
        y = -0.4 + 1.5 * size[1] + gap_m + ball_m
        return shift(0.05, y + rolled_m, TABLE_TOP_M + ball_m) @ turn("x", -np.degrees(rolled_m / ball_m))

    parts = [
        rigid(fine_box(rng, tuple(size.tolist()), RED, 0.012), first),
        rigid(fine_box(rng, tuple(size.tolist()), BLUE, 0.012), second),
        rigid(fine_ball(rng, SAND, ball_m), rolling),
    ]
    return as_object(parts, table(rng, options, (0.6, 1.1)))


def plant(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A flower in a pot on a table, which bends over and rises again while its leaves open and close."""
    size_m = 0.36
    foot = np.array([0.1, 0.0, TABLE_TOP_M + 1.15 * size_m])
    model = flower(rng, options.motion_scale)

    def grown(part: Part) -> Part:
        def vertices_at(time: float) -> np.ndarray:
            wave = 0.5 - 0.5 * np.cos(2 * np.pi * max(time, 0.0) / 2.4)
            return foot + size_m * part.vertices_at(float(wave))

        return Part(replace(part.rest, vertices=vertices_at(0.0)), vertices_at)

    return as_object([grown(part) for part in model], table(rng, options, (0.7, 0.9)))


def leaving(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A small aircraft that takes off from a table, flies out of most pictures, comes back and lands elsewhere."""

    def at(time: float) -> Pose:
        gone = options.motion_scale * (0.5 - 0.5 * np.cos(2 * np.pi * np.clip(time / OUT_AND_BACK_S, 0, 1)))
        risen = options.motion_scale * (ease(time, 0.0, 0.5) - ease(time, 1.6, 2.1))
        landed = options.motion_scale * ease(time, 0.0, OUT_AND_BACK_S)
        pose = shift(0.1 - 0.25 * gone, -0.12 + FAR_M * gone + 0.2 * landed, TABLE_TOP_M + 0.09 + 0.3 * risen)
        return (
            pose @ turn("x", -18 * gone * (1 if time < OUT_AND_BACK_S / 2 else -1)) @ turn("z", 40 * landed)
        )

    parts = [rigid(fine_box(rng, (0.22, 0.22, 0.16), RED, 0.05), at)]
    for k in range(4):
        angle = np.radians(45 + 90 * k)
        x, y = 0.2 * np.cos(angle), 0.2 * np.sin(angle)
        rotor = fine_box(rng, (0.16, 0.16, 0.03), (BLUE, SAND)[k % 2], 0.015)
        bar = fine_box(rng, (0.2, 0.04, 0.04), WOOD, 0.015)
        parts.append(rigid(rotor, lambda t, x=x, y=y: at(t) @ shift(x, y, 0.05)))
        parts.append(
            rigid(bar, lambda t, x=x, y=y, k=k: at(t) @ shift(x / 2, y / 2, 0.03) @ turn("z", 45 + 90 * k))
        )
    return as_object(parts, table(rng, options, (0.7, 0.9)))


def rod(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A rod of 3 cm that swings like a pendulum under a gallows and turns sideways."""
    length_m, top = 0.55, np.array([0.0, 0.0, 1.4])

    def at(time: float) -> Pose:
        w = 2 * np.pi * 0.7 * max(time, 0.0)
        grown = options.motion_scale * ease(time, 0.0, 0.4)
        return (
            shift(*top.tolist()) @ turn("x", 38 * grown * np.sin(w)) @ turn("y", 22 * grown * np.sin(0.6 * w))
        )

    contrast = options.texture_contrast
    post = box(rng, np.array([-0.3, 0.0, 0.9]), np.array([0.04, 0.04, 1.1]), 0.0, contrast, WOOD)
    beam = box(rng, np.array([-0.14, 0.0, 1.43]), np.array([0.36, 0.04, 0.04]), 0.0, contrast, WOOD)
    return as_object([rigid(limb(rng, SAND, length_m, 0.015, 0.015), at)], [*post, *beam])


def as_object(parts: Sequence[Part], stand: Sequence[Mesh]) -> MovingObject:
    """The parts as one mesh; their textures lie one above the other in one picture."""
    meshes = [part.rest for part in parts]
    width = max(mesh.texture.shape[1] for mesh in meshes)
    height = sum(mesh.texture.shape[0] for mesh in meshes)
    uv, textures, row = [], [], 0
    for mesh in meshes:
        rows, columns = mesh.texture.shape[:2]
        inner = np.clip(mesh.uv, 0.5 / np.array([columns, rows]), 1 - 0.5 / np.array([columns, rows]))
        uv.append((inner * [columns, rows] + [0, row]) / [width, height])
        textures.append(np.pad(mesh.texture, ((0, 0), (0, width - columns), (0, 0)), mode="edge"))
        row += rows
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])

    def vertices_at(time_s: float) -> np.ndarray:
        return np.concatenate([part.vertices_at(time_s) for part in parts])

    rest = Mesh(
        vertices_at(0.0),
        np.concatenate([mesh.faces + n for mesh, n in zip(meshes, first[:-1], strict=True)]),
        np.concatenate(uv),
        np.concatenate(textures),
        smooth=True,
    )
    return MovingObject(rest, vertices_at, tuple(stand))


def limb(rng: np.random.Generator, paint: Paint, length_m: Number, top_m: Number, end_m: Number) -> Mesh:
    """A round limb that hangs down from the origin, with radii at its top and its end."""
    low, high = np.linspace(-np.pi / 2, 0, 8), np.linspace(0, np.pi / 2, 8)
    r = np.concatenate([end_m * np.cos(low), top_m * np.cos(high)]) * FINE
    z = np.concatenate([end_m * np.sin(low) - length_m, top_m * np.sin(high)]) * FINE
    return _shrunk(turned(rng, paint, [(float(a), float(b)) for a, b in zip(r, z, strict=True)]))


def fine_box(
    rng: np.random.Generator, size_m: tuple[Number, Number, Number], paint: Paint, radius_m: Number
) -> Mesh:
    """A rounded box, its texture as fine as a small thing's."""
    x, y, z = (FINE * side for side in size_m)
    return _shrunk(rounded_box(rng, (x, y, z), paint, FINE * radius_m))


def fine_ball(rng: np.random.Generator, paint: Paint, radius_m: Number) -> Mesh:
    """The same for a ball."""
    return _shrunk(ball(rng, paint, FINE * radius_m))


def _shrunk(mesh: Mesh) -> Mesh:
    return replace(mesh, vertices=mesh.vertices / FINE)


def table(
    rng: np.random.Generator,
    options: SessionOptions,
    size_m: tuple[Number, Number],
    top_m: Number = TABLE_TOP_M,
    middle_m: tuple[Number, Number] = (0.0, 0.0),
) -> list[Mesh]:
    """A block on the platform with a top of this size at a height."""
    size = np.array([*size_m, top_m - PLATFORM_M])
    middle = np.array([*middle_m, (top_m + PLATFORM_M) / 2])
    return box(rng, middle, size, 0.0, options.texture_contrast, WOOD)
