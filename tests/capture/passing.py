"""A model passes a fixed camera before a wall and on a floor, with its shadow: pictures and exact mattes.

The world is that of `simulate_forward`: x right, z up; the camera looks along +y. The model crosses the picture
from left to right while it moves as it does, and stands on the floor.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.protocol.simulate_dataset import lens
from devrf.lab.simulate.render.studio import Studio
from devrf.lab.simulate.scenes.catalogue import Mesh, Paint, picture_on_quad, texture
from devrf.lab.simulate.scenes.models import MODELS

FLOOR_Z, WALL_Y, HALF, SPAN = -1.0, 1.6, 4.5, 2.0  # world units; the middle goes from -SPAN to SPAN
TEXELS, TEXEL = 400, 0.02
PAINT = Paint((150, 160, 170), 38.0)


def simulate_passing(
    scene: str, frames: int, size: tuple[int, int], seed: int, spp: int = 16
) -> tuple[UInt8[np.ndarray, "n h w 3"], Float[np.ndarray, "n h w"]]:
    """Render the clip.

    Args:
        scene: A name out of `MODELS`.
        frames: Number of pictures.
        size: Width and height.
        seed: Different seeds give other textures.
        spp: Light paths per pixel.
    Returns:
        Pictures, sRGB, and the share of every pixel that the model covers.
    """
    model = MODELS[scene].build(np.random.default_rng([seed, 0]), 1.0)
    room, studio = _room(np.random.default_rng([seed, 1])), Studio(spp)
    camera = Camera(*size, lens(size), look_at(np.array([0.0, -5.2, 1.2]), np.array([0.0, 0.0, -0.1])))
    pictures, mattes = [], []
    for n, time in enumerate(np.linspace(0, 1, frames)):
        meshes = [part.at(float(time)) for part in model]
        lowest = min(float(mesh.vertices[:, 2].min()) for mesh in meshes)
        move = np.array([(2 * time - 1) * SPAN, 0.0, FLOOR_Z - lowest])
        meshes = [replace(mesh, vertices=mesh.vertices + move) for mesh in meshes]
        pictures.append(studio.stage([*meshes, *room]).picture(camera, n)[..., :3])
        mattes.append(studio.stage(meshes).coverage(camera, n).clip(0, 1))
    return np.stack(pictures), np.stack(mattes)


def _room(rng: np.random.Generator) -> list[Mesh]:
    """Wall and floor, textured."""
    edge = [(-HALF, WALL_Y, FLOOR_Z), (HALF, WALL_Y, FLOOR_Z)]
    wall = [(-HALF, WALL_Y, HALF), (HALF, WALL_Y, HALF), *edge[::-1]]
    floor = [*edge, (HALF, -HALF, FLOOR_Z), (-HALF, -HALF, FLOOR_Z)]
    paint = {"paint": PAINT, "sizes_m": (0.08, 0.8)}
    return [
        picture_on_quad(np.array(corners, float), texture(rng, (TEXELS, TEXELS), TEXEL, 1.0, **paint))
        for corners in (wall, floor)
    ]
