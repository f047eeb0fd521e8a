"""Objects that deform: a sheet, whole or cut into strips, and a soft column.

The one that changes is in `changing.py`, those of several bodies in `bodies.py`, persons in `people.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from devrf.lab.simulate.scenes.bodies import blocks, leaving, plant, rod
from devrf.lab.simulate.scenes.catalogue import PRINT, WOOD, Mesh, MovingObject, box, texture
from devrf.lab.simulate.scenes.changing import changing, ease
from devrf.lab.simulate.scenes.people import figure, gesturing, hiding, kicking, pair, placing
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import quads
from devrf.lab.simulate.scenes.workshop import working

SHEET_WIDTH_M, SHEET_HEIGHT_M, SHEET_TOP_M = 0.9, 0.85, 1.45
COLUMN_RADIUS_M, COLUMN_HEIGHT_M, COLUMN_FOOT_M = 0.2, 0.95, 0.45
START_S = 0.4  # the motion grows to its full amplitude within this time


def make_object(name: str, rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """The deforming object of a scene: a name out of `OBJECTS`."""
    return OBJECTS[name].make(rng, options)


def _sheet(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A cloth sheet that hangs from a bar and waves; every thread from top to bottom keeps its length."""
    contrast, motion_scale = options.texture_contrast, options.motion_scale
    rows, strips = 64, round(0.5 * (SHEET_WIDTH_M / options.strip_m + 1)) if options.strip_m else 0
    across = np.linspace(-0.5, 0.5, 68) * SHEET_WIDTH_M
    if strips:
        lefts = np.linspace(-0.5 * SHEET_WIDTH_M, 0.5 * SHEET_WIDTH_M - options.strip_m, strips)
        across = (lefts[:, None] + options.strip_m * np.array([0.0, 0.5, 1.0])).ravel()
    columns, y0 = len(across), across[None, :]
    s = np.linspace(0, 1, rows)[:, None]  # along a thread, 0 at the bar
    phases = rng.uniform(-0.4, 0.4, 4)

    def vertices_at(time_s: float) -> np.ndarray:
        amount = motion_scale * ease(time_s / START_S)
        w = 2 * np.pi * 0.42 * max(time_s, 0.0)
        folds = 0.10 * np.sin(2 * np.pi * y0 / 0.62 + 0.5) * np.ones_like(s)
        swing = 0.20 * np.sin(w) + 0.16 * np.sin(w - 2.2 * s + 2.0 * y0 + phases[0])
        wave = 0.26 * s * np.sin(1.6 * w - 5.0 * s + 3.0 * y0 / SHEET_WIDTH_M + phases[1])
        angle = folds + amount * (swing + wave)
        sway = amount * 0.17 * np.sin(0.8 * w + phases[2] * s) * s
        ds = SHEET_HEIGHT_M / (rows - 1)
        steps = np.stack(
            [np.sin(angle) * np.cos(sway), np.sin(sway) * np.ones_like(angle), -np.cos(angle) * np.cos(sway)],
            -1,
        )
        steps = np.concatenate([np.zeros_like(steps[:1]), (steps[1:] + steps[:-1]) / 2])
        top = np.stack([np.zeros_like(y0), y0, np.full_like(y0, SHEET_TOP_M)], -1)
        return (top + ds * np.cumsum(steps, axis=0)).reshape(-1, 3)

    faces, uv = _grid(rows, columns)
    # The print goes across the whole sheet, gaps included.
    uv[:, 0] = np.tile(across / SHEET_WIDTH_M + 0.5, rows)
    if strips:
        left_vertex = faces.min(1) % columns
        faces = faces[left_vertex % 3 != 2]  # between two strips there is nothing
    cloth = texture(rng, (425, 450), 0.002, contrast, paint=PRINT, sizes_m=(0.035, 0.16))
    rest = Mesh(vertices_at(0.0), faces[:, ::-1].copy(), uv, cloth, smooth=True, thickness_m=0.002)
    stand = []
    for side in (-1, 1):
        post = np.array([0.0, side * (SHEET_WIDTH_M / 2 + 0.04), (SHEET_TOP_M + 0.35) / 2 + 0.01])
        stand += box(rng, post, np.array([0.03, 0.03, SHEET_TOP_M - 0.33]), 0.0, contrast, WOOD)
    bar = np.array([0.0, 0.0, SHEET_TOP_M + 0.018])
    stand += box(rng, bar, np.array([0.035, SHEET_WIDTH_M + 0.14, 0.035]), 0.0, contrast, WOOD)
    return MovingObject(rest, vertices_at, tuple(stand))


def _column(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """A soft column on a plinth that bends, twists and is squashed; its foot does not move."""
    contrast, motion_scale = options.texture_contrast, options.motion_scale
    rows, around = 56, 72
    rise = np.linspace(0, np.pi / 2, 17)[1:]  # angle along the rounded top
    s = np.concatenate([np.linspace(0, 0.85, rows - 16), 0.85 + 0.15 * np.sin(rise)])[:, None]
    turn = np.linspace(np.pi, 3 * np.pi, around)[None, :]  # the seam, there twice, is behind
    phases = rng.uniform(-0.4, 0.4, 4)
    bulges = 1 + 0.10 * np.sin(2 * np.pi * 1.3 * s + 0.6) + 0.07 * np.cos(3 * turn + 2 * s)
    cap = np.concatenate([np.ones(rows - 16), np.cos(rise)])[:, None]
    radius = COLUMN_RADIUS_M * bulges * np.maximum(cap, 0.005)  # a last ring of 1 mm keeps its normals

    def vertices_at(time_s: float) -> np.ndarray:
        amount = motion_scale * ease(time_s / START_S)
        w = 2 * np.pi * 0.42 * max(time_s, 0.0)
        squash = 1 - amount * 0.12 * (1 - np.cos(1.3 * w)) / 2
        bend_x = amount * s * (0.50 * np.sin(w) + 0.16 * np.sin(1.7 * w - 2 * s + phases[0]))
        bend_y = amount * s * (0.45 * np.sin(0.8 * w + phases[1] * s) + 0.12 * np.sin(1.9 * w - 3 * s))
        twist = amount * 0.7 * s * np.sin(1.1 * w)
        ds = squash * COLUMN_HEIGHT_M * np.diff(s, axis=0)
        axis = np.concatenate(
            [np.sin(bend_x), np.sin(bend_y) * np.cos(bend_x), np.cos(bend_y) * np.cos(bend_x)], -1
        )
        spine = np.cumsum(np.concatenate([np.zeros((1, 3)), ds * (axis[1:] + axis[:-1]) / 2]), axis=0)
        side = np.concatenate([np.cos(bend_x), np.zeros_like(s), -np.sin(bend_x)], -1)
        side -= axis * (side * axis).sum(-1, keepdims=True)
        side /= np.linalg.norm(side, axis=-1, keepdims=True)
        other = np.cross(axis, side)
        r = radius / np.sqrt(squash)  # what it loses in height it gains in width
        ring = (
            np.cos(turn + twist)[..., None] * side[:, None] + np.sin(turn + twist)[..., None] * other[:, None]
        )
        foot = np.array([0.0, 0.0, COLUMN_FOOT_M])
        return (foot + spine[:, None] + r[..., None] * ring).reshape(-1, 3)

    faces, uv = _grid(rows, around)
    skin = texture(rng, (475, 628), 0.002, contrast, paint=PRINT, sizes_m=(0.035, 0.16))
    rest = Mesh(vertices_at(0.0), faces, uv, skin, smooth=True)
    plinth = box(rng, np.array([0.0, 0.0, 0.4]), np.array([0.5, 0.5, 0.1]), 20.0, contrast, WOOD)
    return MovingObject(rest, vertices_at, tuple(plinth))


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces and texture coordinates of a grid of vertices, row by row."""
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return quads(rows, columns), np.stack([u, v], -1).reshape(-1, 2)


PHONES = tuple(  # of phones: 25 and 30 hertz, 1/100 s, one upright
    "room=workshop sweep_frames=68 sweep_aim_m=1.3 fps=25 other_fps=30 portrait=true duration_s=2.6 rest_s=0.25 "
    "camera_distance_m=1.75 exposure_s=0.01 noise=0.008 spp=4 crf=22".split()
)


@dataclass(frozen=True)
class ObjectKind:
    """An object to choose.

    Attributes:
        about: What it is and does, in a few words.
        make: Who makes it.
        size: Of its pictures on the command line, where none is given; None: the protocol's.
        usual: Options on the command line that are not the defaults for it, unless others are given.
    """

    about: str
    make: Callable[[np.random.Generator, SessionOptions], MovingObject]
    size: str | None = None
    usual: tuple[str, ...] = ()


OBJECTS = {
    "sheet": ObjectKind("a cloth sheet that hangs from a bar and waves", _sheet),
    "column": ObjectKind("a soft column that bends, twists and is squashed", _column),
    "changing": ObjectKind("a ball that appears, a block that splits, or one that turns over", changing),
    "blocks": ObjectKind("a block that pushes another, and that one a ball", blocks),
    "figure": ObjectKind("a person who walks", figure),
    "plant": ObjectKind("a flower on a table that bends over and rises again", plant),
    "leaving": ObjectKind("a small aircraft that leaves the pictures and comes back", leaving),
    "gesturing": ObjectKind("a person who stands and talks with the hands", gesturing),
    "kicking": ObjectKind("a person who kicks fast and takes the leg back slowly", kicking),
    "hiding": ObjectKind("a person whose forearm is hidden for half a second and comes back turned", hiding),
    "pair": ObjectKind("two people side by side who gesture", pair),
    "placing": ObjectKind(
        "a person who lifts a cube and puts it down, before things that swing and wave", placing
    ),
    "rod": ObjectKind("a thin rod that swings", rod),
    "workshop": ObjectKind(
        "a workshop: someone lifts a cube, a lamp swings, a towel waves; filmed by phones",
        working,
        "640x360",
        PHONES,
    ),
}
