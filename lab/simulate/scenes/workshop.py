"""A workshop: someone steps up to the bench, lifts a cube and puts it down; a lamp swings, a towel waves.

Axes are those of `scenes`: the fixed cameras look from +x over the bench at the person, who stands on the floor. Times
are seconds since the motion begins, at a motion_speed of 1; `motion_scale` multiplies every way and every angle.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float

from devrf.lab.simulate.scenes import materials
from devrf.lab.simulate.scenes.bodies import as_object, fine_ball, fine_box, limb
from devrf.lab.simulate.scenes.catalogue import (
    ROOM_HALF_M,
    ROOM_HEIGHT_M,
    Mesh,
    MovingObject,
    Paint,
    Room,
    box,
    picture_on_quad,
    texture,
)
from devrf.lab.simulate.scenes.furniture import SPINES
from devrf.lab.simulate.scenes.people import SHIRT, SKIN, Joints, person
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import (
    Number,
    Part,
    Pose,
    cylinder,
    ease,
    quads,
    rigid,
    shift,
    skin,
    turn,
    turned,
)

OAK = Paint((156, 114, 74), surface=materials.wood)
PINE = Paint((196, 158, 110), surface=materials.wood)
FLOOR = Paint((132, 98, 68), surface=materials.planks)
WALL = Paint((204, 196, 180), surface=materials.plaster)
WHITE = Paint((214, 211, 202), surface=materials.painted)
GREEN = Paint((70, 98, 86), surface=materials.painted)
RED = Paint((176, 52, 40), surface=materials.painted)
STEEL = Paint((120, 124, 130), surface=materials.painted)
ENAMEL = Paint((44, 92, 112), surface=materials.painted)
TOOLS = Paint((178, 152, 114), surface=materials.pegboard)
GARDEN = Paint((72, 100, 56), surface=materials.sky)
TOWEL = Paint((196, 206, 212), surface=materials.linen)
TEXEL_M = 0.004
BENCH_M, BENCH_X_M, BENCH_Y_M = 0.74, (-0.2, 0.34), (-0.5, 0.84)  # height, and what the top covers
SIZE = 1.2  # the person against those of `people`
ARM_M = 0.2 * SIZE  # from shoulder to elbow, and from there to the hand
CUBE_M, PALM_M = 0.17, 0.018  # the cube, and the middle of a hand before its side
FROM_M, TO_M, HIGH_M = (
    (-0.09, -0.1),
    (-0.07, 0.2),
    0.17,
)  # where the cube stands, and by how much it is lifted
TOUCH_S, LIFT_S, LAND_S, LEAVE_S = 1.0, 1.1, 2.05, 2.1
LAMP_TOP_M = 1.86
OUTSIDE = np.full((2, 2, 3), (0.86, 0.9, 0.98), np.float32)  # light on what the window shows

Place = tuple[Number, Number, Number]
Span = tuple[Number, Number]


def workshop_room(rng: np.random.Generator, contrast: float) -> Room:
    """Plaster walls with a window, a floor of planks, shelves with books and tools; nothing of it moves."""
    h, top = ROOM_HALF_M, ROOM_HEIGHT_M

    def block(centre: Place, size: Place, paint: Paint, turn_deg: Number = 0.0) -> list[Mesh]:
        return box(rng, np.array(centre), np.array(size), float(turn_deg), contrast, paint)

    def flat(corners: Sequence[Place], paint: Paint, texel_m: float = TEXEL_M) -> Mesh:
        a, b, c, _ = np.array(corners)
        rows, columns = (max(4, round(float(np.linalg.norm(v)) / texel_m)) for v in (c - b, b - a))
        return picture_on_quad(
            np.array(corners), texture(rng, (rows, columns), texel_m, contrast, paint=paint)
        )

    y0, y1, z0, z1 = 0.82, 1.72, 0.98, 2.12  # the window
    middle = (y0 + y1) / 2
    around = [(-h, y0, 0, top), (y1, h, 0, top), (y0, y1, 0, z0), (y0, y1, z1, top)]
    garden = flat([(-7, -4, 6.2), (-7, 10, 6.2), (-7, 10, -1.8), (-7, -4, -1.8)], GARDEN, 0.016)
    hung = [(0.5, 1 - h, 1.77), (-0.3, 1 - h, 1.77), (-0.3, 1 - h, 1.23), (0.5, 1 - h, 1.23)]
    meshes = [
        flat([(-h, h, 0), (h, h, 0), (h, -h, 0), (-h, -h, 0)], FLOOR),
        flat([(h, h, top), (h, -h, top), (h, -h, 0), (h, h, 0)], WALL),
        flat([(-h, h, top), (h, h, top), (h, h, 0), (-h, h, 0)], WALL),
        flat([(h, -h, top), (-h, -h, top), (-h, -h, 0), (h, -h, 0)], WALL),
        *(flat([(-h, a, d), (-h, b, d), (-h, b, c), (-h, a, c)], WALL) for a, b, c, d in around),
        replace(garden, light=OUTSIDE),
        flat([(x, y - 0.96, z) for x, y, z in hung], GARDEN),
    ]
    pieces = [  # middle, size, paint, turn
        *(((-h, y, (z0 + z1) / 2), (0.1, 0.05, z1 - z0 + 0.05), WHITE, 0) for y in (y0, middle, y1)),
        *(((-h, middle, z), (0.1, y1 - y0, 0.05), WHITE, 0) for z in (z0, z0 + 0.66 * (z1 - z0), z1)),
        ((-h + 0.08, middle, z0 - 0.03), (0.2, y1 - y0 + 0.16, 0.03), PINE, 0),
        *(((x, 0, 0.05), (0.03, 2 * h, 0.1), WHITE, 0) for x in (-h, h)),  # skirting
        *(((0, y, 0.05), (2 * h, 0.03, 0.1), WHITE, 0) for y in (-h, h)),
        ((-h + 0.015, 0.12, 1.5), (0.02, 1.16, 0.98), TOOLS, 0),
        ((-h + 0.14, 0.12, 0.42), (0.28, 1.1, 0.84), GREEN, 0),
        ((-h + 0.15, -0.2, 0.92), (0.2, 0.28, 0.16), RED, 6),
        ((-h + 0.15, 0.2, 0.96), (0.16, 0.2, 0.24), STEEL, -4),
        ((-h + 0.15, 0.5, 0.89), (0.2, 0.16, 0.1), PINE, 8),
        ((0.1, -h + 0.02, 1.5), (0.9, 0.03, 0.64), OAK, 0),  # the frame of a picture
        ((-0.2, h - 0.14, 1.42), (1.1, 0.24, 0.03), PINE, 0),  # a shelf
        ((-0.6, h - 0.14, 1.535), (0.16, 0.16, 0.2), ENAMEL, 30),
        ((-0.3, h - 0.14, 1.5), (0.2, 0.16, 0.13), RED, 12),
        ((0.1, h - 0.14, 1.555), (0.14, 0.14, 0.24), STEEL, 20),
        ((-0.5, h - 0.16, 0.3), (1.2, 0.3, 0.6), PINE, 0),
        ((1.7, -1.5, 0.3), (0.4, 0.4, 0.6), PINE, 20),
        ((h - 0.01, -0.9, 1.02), (0.05, 0.98, 2.04), WHITE, 0),  # a door in its frame
        ((h - 0.03, -0.9, 0.99), (0.05, 0.84, 1.94), GREEN, 0),
        ((h - 0.07, -0.55, 1.0), (0.06, 0.1, 0.03), STEEL, 0),
        ((h - 0.015, 0.75, 1.55), (0.02, 1.3, 0.98), TOOLS, 0),
        ((h - 0.15, 0.75, 0.35), (0.3, 1.2, 0.7), OAK, 0),
        ((h - 0.02, -0.1, 1.6), (0.03, 0.3, 0.4), TOWEL, 0),
        ((-0.82, 0.0, 0.23), (0.3, 0.62, 0.44), PINE, 0),  # a crate, on which the board stands
    ]
    for piece in pieces:
        meshes += block(*piece)
    meshes += _drawers(block, -h + 0.285, (-0.43, 0.67), (0.06, 0.8), 4)
    return Room([*meshes, *_bookcase(rng, block, -1.62, -0.62), *_bench(rng, block)], [])


def working(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """Who works there, the cube, the lamp and the towel."""
    scale, top = options.motion_scale, BENCH_M + CUBE_M / 2

    def cube(time: float) -> Pose:
        done = scale * ease(time, LIFT_S + 0.15, LAND_S - 0.1)
        risen = scale * HIGH_M * (ease(time, LIFT_S, LIFT_S + 0.4) - ease(time, LAND_S - 0.45, LAND_S))
        x, y = (1 - done) * np.array(FROM_M) + done * np.array(TO_M)
        return shift(x, y, top + risen) @ turn("z", 14 * done)

    joints = _worker(cube, scale)
    parts = [_grown(part) for part in person(rng, joints, SHIRT)]
    for side in (1, -1):
        palm, forearm = fine_box(rng, (0.075, 0.03, 0.085), SKIN, 0.014), joints.forearm(side)
        parts.append(_grown(rigid(palm, lambda t, f=forearm: f(t) @ shift(0.01, 0, -0.21))))
    toy = fine_box(rng, (CUBE_M, CUBE_M, CUBE_M), RED, 0.012)
    parts.append(rigid(toy, cube))

    def cord(time: float) -> Pose:
        swung = scale * ease(time, 0.0, 0.5) * float(np.sin(2 * np.pi * 0.55 * max(time, 0.0)))
        return shift(-0.05, 0.58, LAMP_TOP_M) @ turn("x", 13.0 * swung)

    shade = turned(
        rng,
        ENAMEL,
        [(0.0, 0.16), (0.33, 0.0)],
        [(0.33, 0.0), (0.36, 0.0)],
        [(0.36, 0.0), (0.12, 0.24), (0.1, 0.3), (0.0, 0.3)],
    )
    parts += [
        rigid(limb(rng, STEEL, 0.56, 0.008, 0.008), cord),
        rigid(replace(shade, vertices=shade.vertices / 3), lambda t: cord(t) @ shift(0, 0, -0.66)),
        rigid(fine_ball(rng, WHITE, 0.04), lambda t: cord(t) @ shift(0, 0, -0.655)),
        _towel(rng, scale),
    ]
    still: list[Mesh] = []
    for middle, size in (
        ((-0.3, -0.98, 0.76), (0.03, 0.03, 1.5)),
        ((-0.3, -0.54, 0.76), (0.03, 0.03, 1.5)),
        ((-0.3, -0.76, 1.49), (0.025, 0.5, 0.025)),
        ((-1.02, 0.58, LAMP_TOP_M + 0.03), (1.96, 0.05, 0.06)),  # a beam, from which the lamp hangs
    ):
        still += box(rng, np.array(middle), np.array(size), 0.0, options.texture_contrast, OAK)
    return as_object(parts, still)


def _worker(cube: Callable[[float], Pose], scale: float) -> Joints:
    """Two steps up to the bench; then both hands reach for the cube's sides, and go with it until it stands."""

    def walked(time: float) -> float:
        return scale * ease(time, 0.0, 0.95)

    def stride(time: float, side: int) -> float:
        return scale * side * float(np.sin(2 * np.pi * ease(time, 0.0, 0.95)))

    def hip(time: float) -> Pose:
        x, y = -0.36 / SIZE, (-0.24 + 0.28 * walked(time)) / SIZE
        return shift(x, y, 0.62) @ turn("z", 40.0 * (1 - walked(time)))

    def chest(time: float) -> Pose:
        turned_deg = scale * (22.0 * ease(time, LIFT_S + 0.1, LAND_S - 0.2) - 12.0 * ease(time, 0.3, TOUCH_S))
        return (
            hip(time)
            @ shift(0, 0, 0.15)
            @ turn("z", turned_deg)
            @ turn("y", 9.0 * scale * ease(time, 0.4, TOUCH_S))
        )

    def neck(time: float) -> Pose:
        return chest(time) @ shift(0, 0, 0.32) @ turn("y", 14.0 * scale * ease(time, 0.2, 0.8))

    def thigh(side: int) -> Callable[[float], Pose]:
        return lambda t: hip(t) @ shift(0, 0.075 * side, -0.01) @ turn("y", -20.0 * stride(t, side))

    def shin(side: int) -> Callable[[float], Pose]:
        upper = thigh(side)
        return lambda t: upper(t) @ shift(0, 0, -0.29) @ turn("y", 26.0 * max(stride(t, side), 0.0))

    def arm(side: int, time: float) -> tuple[Pose, Pose]:
        """Of the upper arm and of the forearm, in the person's lengths."""
        shoulder = (chest(time) @ shift(0, 0.135 * side, 0.21))[:3, 3]
        hanging = (chest(time) @ shift(0.1, 0.2 * side, -0.145))[:3, 3]
        away = PALM_M + 0.07 * scale * ease(time, LEAVE_S, LEAVE_S + 0.3)
        held = (cube(time) @ shift(-0.01, side * (CUBE_M / 2 + away), 0.01))[:3, 3] / SIZE
        near = scale * ease(time, 0.25, TOUCH_S)
        wide = np.array([0, side * 0.07 * np.sin(np.pi * near), 0.05 * np.sin(np.pi * near)])
        return _bent_arm(shoulder, (1 - near) * hanging + near * held + wide, side)

    def upper_arm(side: int) -> Callable[[float], Pose]:
        return lambda t: arm(side, t)[0]

    def forearm(side: int) -> Callable[[float], Pose]:
        return lambda t: arm(side, t)[1]

    return Joints(hip, chest, neck, thigh, shin, upper_arm, forearm)


def _bent_arm(shoulder: Float[np.ndarray, "3"], hand: Float[np.ndarray, "3"], side: int) -> tuple[Pose, Pose]:
    """An arm from here to there whose elbow is low and outside: two limbs that hang down from their origins."""
    length = ARM_M / SIZE
    way = hand - shoulder
    straight = min(float(np.linalg.norm(way)), 1.998 * length)
    along = way / np.linalg.norm(way)
    out = np.array([-0.5, 0.9 * side, -0.8])
    out -= (out @ along) * along
    elbow = shoulder + straight / 2 * along + np.sqrt(length**2 - straight**2 / 4) * out / np.linalg.norm(out)
    return _hanging(shoulder, elbow), _hanging(elbow, shoulder + straight * along)


def _hanging(start: np.ndarray, end: np.ndarray) -> Pose:
    """From `start` the z axis points away from `end`, and the x axis ahead."""
    z = (start - end) / np.linalg.norm(start - end)
    y = np.cross(z, [1.0, 0.0, 0.2])
    y /= np.linalg.norm(y)
    pose = np.eye(4)
    pose[:3] = np.stack([np.cross(y, z), y, z, start], -1)
    return pose


def _grown(part: Part) -> Part:
    """A part of the person, who is taller than those of `people`."""
    return Part(replace(part.rest, vertices=SIZE * part.rest.vertices), lambda t: SIZE * part.vertices_at(t))


def _towel(rng: np.random.Generator, scale: float) -> Part:
    """Hangs from its rail in folds and waves in a draught; both sides are there."""
    rows, columns, wide_m, high_m = 26, 24, 0.36, 0.56
    down, across = np.linspace(0, 1, rows)[:, None], np.linspace(-0.5, 0.5, columns)[None, :]
    uv = np.stack(np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)), -1).reshape(-1, 2)

    def vertices_at(time: float) -> np.ndarray:
        w = 2 * np.pi * 0.6 * max(time, 0.0)
        wave = (
            0.1
            * scale
            * ease(time, 0.0, 0.6)
            * down
            * (np.sin(w - 3.0 * down + 2.5 * across) + np.sin(3.0 * down) * 0.2)
        )
        folds = 0.016 * np.sin(2 * np.pi * 3.5 * across + 0.8) * (0.4 + 0.6 * down)
        x = -0.28 + wave + folds
        front = np.stack([x, -0.76 + wide_m * across + 0 * x, 1.475 - high_m * down + 0 * x], -1).reshape(
            -1, 3
        )
        return np.concatenate([front, front - [0.004, 0.0, 0.0]])

    faces = quads(rows, columns)[:, ::-1]
    both = np.concatenate([faces, faces[:, ::-1] + rows * columns])
    cloth = skin(rng, 2 * wide_m, 2 * high_m, TOWEL)
    return Part(Mesh(vertices_at(0.0), both, np.tile(uv, (2, 1)), cloth, smooth=True), vertices_at)


def _bench(rng: np.random.Generator, block: Callable[..., list[Mesh]]) -> list[Mesh]:
    """A thick top on a chest of drawers, with what lies about on it."""
    (x0, x1), (y0, y1), z = BENCH_X_M, BENCH_Y_M, BENCH_M
    x, y, wide, long = (x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0
    pieces = [
        *(
            ((x0 + (n + 0.5) * wide / 3, y, z - 0.025), (wide / 3 - 0.002, long, 0.05), OAK, 0)
            for n in range(3)
        ),
        *(
            (
                (x + a * (wide / 2 - 0.05), y + b * (long / 2 - 0.06), z / 2 - 0.025),
                (0.08, 0.08, z - 0.05),
                OAK,
                0,
            )
            for a in (-1, 1)
            for b in (-1, 1)
        ),
        ((x, y, 0.36), (wide - 0.14, long - 0.2, 0.62), PINE, 0),
        ((0.2, 0.66, z + 0.05), (0.14, 0.24, 0.1), RED, 12),
        ((0.12, -0.36, z + 0.07), (0.1, 0.12, 0.14), ENAMEL, 30),
        ((0.24, -0.2, z + 0.01), (0.05, 0.26, 0.02), STEEL, 25),
        ((0.2, 0.3, z + 0.004), (0.3, 0.03, 0.008), PINE, 65),
        ((-0.08, 0.62, z + 0.025), (0.18, 0.12, 0.05), GREEN, -20),
        ((-0.08, 0.62, z + 0.07), (0.15, 0.1, 0.04), WHITE, -8),
    ]
    meshes = _drawers(block, x1 - 0.065, (y0 + 0.12, y1 - 0.12), (0.08, 0.66), 3)
    for piece in pieces:
        meshes += block(*piece)
    jar = shift(0.18, 0.46, z)
    meshes.append(rigid(cylinder(rng, STEEL, 0.045, 0.0, 0.12, 0.006), jar).rest)
    for n, paint in enumerate((RED, PINE, GREEN, ENAMEL)):  # pencils
        lean = jar @ turn("z", 90 * n + 20) @ turn("y", 8) @ shift(0.02, 0, 0.21)
        meshes.append(rigid(limb(rng, paint, 0.2, 0.006, 0.006), lean).rest)
    return meshes


def _drawers(block: Callable[..., list[Mesh]], x: float, y: Span, z: Span, columns: int) -> list[Mesh]:
    """Three rows of fronts with knobs, that look towards +x."""
    meshes, wide, high = [], (y[1] - y[0]) / columns, (z[1] - z[0]) / 3
    for n in range(3 * columns):
        middle = y[0] + (n % columns + 0.5) * wide, z[0] + (n // columns + 0.5) * high
        meshes += block((x, *middle), (0.03, wide - 0.014, high - 0.014), PINE if columns == 3 else GREEN)
        meshes += block((x + 0.025, *middle), (0.02, 0.05, 0.014), STEEL)
    return meshes


def _bookcase(rng: np.random.Generator, block: Callable[..., list[Mesh]], y0: float, y1: float) -> list[Mesh]:
    """Against the wall at -x, five boards, full of books."""
    x, deep, step = -ROOM_HALF_M, 0.27, 0.37
    middle, top = (y0 + y1) / 2, 5 * step
    meshes = block((x + 0.01, middle, top / 2), (0.015, y1 - y0, top), OAK)
    for y in (y0, y1):
        meshes += block((x + deep / 2, y, top / 2), (deep, 0.03, top + 0.04), OAK)
    for n in range(6):
        meshes += block((x + deep / 2, middle, 0.03 + n * step), (deep, y1 - y0, 0.025), OAK)
        at = y0 + 0.03
        while n < 5 and at < y1 - 0.09:
            thick, tall, out = rng.uniform(0.02, 0.055), rng.uniform(0.19, 0.31), rng.uniform(0.17, 0.22)
            book = Paint(SPINES[rng.integers(len(SPINES))], surface=partial(_bound, int(rng.integers(3))))
            centre = (x + 0.02 + out / 2, at + thick / 2, 0.044 + n * step + tall / 2)
            front, _, _, _, lid, _ = block(centre, (out, thick - 0.002, tall), book)
            meshes += [front, lid]
            at += thick + (0.1 * rng.random() if rng.random() < 0.1 else 0.0)
    return meshes


def _bound(
    bands: int, rng: np.random.Generator, shape: tuple[int, int], texel_m: float, tint: tuple[int, int, int]
) -> np.ndarray:
    """A book's back: cloth with a label and gilt bands."""
    picture = np.ascontiguousarray(materials.painted(rng, shape, texel_m, tint), dtype=np.float32)
    rows, columns = shape
    for n in range(bands + 1):
        row = round(rows * (0.08 + 0.13 * n))
        cv2.line(picture, (0, row), (columns, row), (206, 176, 106), 1)
    cv2.rectangle(
        picture,
        (1, round(rows * 0.5)),
        (max(1, columns - 2), round(rows * rng.uniform(0.6, 0.8))),
        (222, 212, 190),
        -1,
    )
    return picture
