"""Light that has come a long way: of the sky, of the sun through a window, and sent back by walls and furniture.

Where nothing moves it is the same in all pictures, so it is computed once, as a coarse picture of light on every flat
surface; `Renderer` adds the lamp, whose shadows follow what moves.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from devrf.lab.simulate.render.mitsuba import ShapeMaker, load_mitsuba, srgb_to_linear
from devrf.lab.simulate.render.renderer import Light
from devrf.lab.simulate.scenes.catalogue import Mesh

SKY, SUN = (0.3, 0.335, 0.385), (3.9, 3.4, 2.6)  # radiance from above; irradiance across the beam
DAYLIGHT = Light((0.7, 1.5, 3.0), (0.0, 0.0, 0.8), 0.6, (7.8, 7.3, 6.4), 0.38)
SUN_DIRECTION = (0.5, 0.42, -0.76)
CELL_M = 0.03  # of the pictures of light
MOST_CELLS = 96  # along a side
PATHS = 64  # per cell
BOUNCES = 4
BEFORE_M = 0.004  # from where light on a surface is looked at
ATLAS_TEXELS = 2048  # width of the texture of many meshes


def lit(still: Sequence[Mesh], light: Light, seed: int) -> list[Mesh]:
    """The same surfaces, which know the light on them but for the direct light of the lamp, as few meshes.

    A mesh that already knows its light is far away and keeps none from the others.
    """
    mi = load_mitsuba()
    here = [mesh for mesh in still if mesh.light is None]
    room = {"type": "scene", "room": ShapeMaker(mi)(merged(here)), "lamp": light.lamp(mi)}
    beam = {"type": "rgb", "value": list(SUN)}
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": list(SKY)}}
    sun = {"type": "directional", "direction": list(SUN_DIRECTION), "irradiance": beam}
    every = mi.load_dict(
        {**room, "integrator": {"type": "path", "max_depth": BOUNCES}, "sky": sky, "sun": sun}
    )
    direct = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
    of_lamp = mi.load_dict({**room, "integrator": direct})
    found = []
    for n, mesh in enumerate(here):
        if len(mesh.vertices) == 4:
            sensor = mi.load_dict(_sensor_before(mi, mesh))
            seen = [np.array(mi.render(scene, sensor=sensor, seed=seed + n)) for scene in (every, of_lamp)]
            cells = seen[0].shape[1::-1]
            albedo = cv2.resize(srgb_to_linear(mesh.texture), cells, interpolation=cv2.INTER_AREA)
            blurred = cv2.GaussianBlur(((seen[0] - seen[1]) / albedo).astype(np.float32), (0, 0), 1.1)
            mesh = replace(mesh, light=blurred.clip(0))
        else:
            mesh = replace(mesh, light=np.full((2, 2, 3), light.ambient, np.float32))
        found.append(mesh)
    return [merged(found), *(mesh for mesh in still if mesh.light is not None)]


def merged(meshes: Sequence[Mesh]) -> Mesh:
    """All as one, whose texture holds theirs in rows, and its light theirs: many shapes make Mitsuba slow."""
    sizes = [mesh.texture.shape[:2] for mesh in meshes]
    width = max(ATLAS_TEXELS, *(columns for _, columns in sizes))
    corners, x, y, high = {}, 0, 0, 0
    for n in sorted(range(len(meshes)), key=lambda n: -sizes[n][0]):
        rows, columns = sizes[n]
        if x + columns > width:
            x, y, high = 0, y + high, 0
        corners[n], x, high = (y, x), x + columns, max(high, rows)
    texture = np.zeros((y + high, width, 3), np.uint8)
    light = np.zeros(texture.shape, np.float32)
    vertices, faces, uv = [], [], []
    for n, mesh in enumerate(meshes):
        (rows, columns), (y, x) = sizes[n], corners[n]
        texture[y : y + rows, x : x + columns] = mesh.texture
        if mesh.light is not None:
            light[y : y + rows, x : x + columns] = cv2.resize(mesh.light, (columns, rows))
        inner = np.clip(mesh.uv * [columns, rows], 0.5, np.array([columns, rows]) - 0.5)
        uv.append((inner + [x, y]) / texture.shape[1::-1])
        faces.append(mesh.faces + sum(len(v) for v in vertices))
        vertices.append(mesh.vertices)
    every = np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv)
    return Mesh(*every, texture, light=light if any(mesh.light is not None for mesh in meshes) else None)


def _sensor_before(mi: Any, mesh: Mesh) -> dict[str, Any]:
    """A camera close before a picture on a quad, which sees just that."""
    a, b, c, d = mesh.vertices  # top left, top right, bottom right, bottom left
    right, up = (b - a) / 2, (a - d) / 2
    out = np.cross(right, up)
    out /= np.linalg.norm(out)
    width, height = (2 * float(np.linalg.norm(v)) for v in (right, up))
    cells = [int(np.clip(round(length / CELL_M), 2, MOST_CELLS)) for length in (width, height)]
    looking = np.eye(4)  # Mitsuba: x left, y up, z ahead; the picture is as high as the film is to its width
    looking[:3, :3] = np.stack([-right, up * cells[0] / cells[1], -out], -1)
    looking[:3, 3] = (a + c) / 2 + BEFORE_M * out
    film = {
        "type": "hdrfilm",
        "width": cells[0],
        "height": cells[1],
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
    }
    return {
        "type": "orthographic",
        "near_clip": BEFORE_M / 10,
        "far_clip": 2 * BEFORE_M,
        "to_world": mi.ScalarTransform4f(looking),
        "film": film,
        "sampler": {"type": "independent", "sample_count": PATHS},
    }
