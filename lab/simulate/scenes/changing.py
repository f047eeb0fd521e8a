"""An object that the scene at rest cannot explain: it appears, splits, or shows a side that nobody has seen.

It stands on a plinth in the room of `scenes`. `motion_scale` says how far it goes: times 0.2 m of a ball's radius,
0.15 m that a half moves, or 90 degrees of a turn.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from devrf.lab.simulate.scenes.catalogue import PLATFORM_M, PRINT, WOOD, Mesh, MovingObject, box, texture
from devrf.lab.simulate.scenes.session_options import SessionOptions
from devrf.lab.simulate.scenes.shapes import ball, rounded_box, turn

TOP_M = 0.78  # of the plinth, so that what stands on it is in the middle of the pictures
BALL_M, PART_M, TURN_DEG = 0.2, 0.15, 90.0  # at a motion_scale of 1
SEED_M = 1e-3  # radius of a ball that is not there yet: its normals are defined, and no pixel shows it
BLOCK_M = (0.34, 0.44, 0.36)
DURATION_S = 1.0  # of the whole change, at a motion_speed of 1

Changed = tuple[
    Mesh, Callable[[float], np.ndarray]
]  # a shape, and its vertices when so much of the change is done


def changing(rng: np.random.Generator, options: SessionOptions) -> MovingObject:
    """What `options.change` says, with a print like the sheet's, on its plinth."""
    shape, vertices_at = CHANGES[options.change](rng, options.motion_scale)
    contrast = options.texture_contrast
    print_ = texture(rng, (440, 660), 0.002, contrast, paint=PRINT, sizes_m=(0.035, 0.16))
    rest = replace(shape, vertices=vertices_at(0.0), texture=print_)
    size = np.array([0.5, 0.6, TOP_M - PLATFORM_M])
    middle = np.array([0.0, 0.0, (TOP_M + PLATFORM_M) / 2])
    stand = tuple(box(rng, middle, size, 0.0, contrast, WOOD))
    return MovingObject(rest, lambda time_s: vertices_at(ease(time_s / DURATION_S)), stand)


def ease(x: float) -> float:
    """From 0 at 0 to 1 at 1, slowly at both ends."""
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)


def _appears(rng: np.random.Generator, scale: float) -> Changed:
    """A ball that grows out of nothing."""
    shape = ball(rng, PRINT, 1.0)

    def vertices_at(done: float) -> np.ndarray:
        radius = SEED_M + scale * BALL_M * done
        return radius * shape.vertices + [0.0, 0.0, TOP_M + radius]

    return shape, vertices_at


def _parts(rng: np.random.Generator, scale: float) -> Changed:
    """A block whose left and right halves move apart; at rest their faces touch and nobody sees them."""
    x, y, z = BLOCK_M
    half = rounded_box(rng, (x, y / 2, z), PRINT, 0.01)
    count = len(half.vertices)
    sides = np.repeat([-1.0, 1.0], count)[:, None] * [0.0, 1.0, 0.0]
    at_rest = np.tile(half.vertices, (2, 1)) + y / 4 * sides + [0.0, 0.0, TOP_M + z / 2]
    faces = np.concatenate([half.faces, half.faces + count])
    both = replace(half, vertices=at_rest, faces=faces, uv=np.tile(half.uv, (2, 1)))
    return both, lambda done: at_rest + scale * PART_M * done * sides


def _tumbles(rng: np.random.Generator, scale: float) -> Changed:
    """A block that turns over towards the fixed cameras, its lowest point always on the plinth."""
    block = rounded_box(rng, BLOCK_M, PRINT, 0.03)

    def vertices_at(done: float) -> np.ndarray:
        turned = block.vertices @ turn("y", -TURN_DEG * scale * done)[:3, :3].T
        return turned + [0.0, 0.0, TOP_M - turned[:, 2].min()]

    return block, vertices_at


CHANGES = {"appear": _appears, "part": _parts, "tumble": _tumbles}
