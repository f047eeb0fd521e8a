"""Shapes and textures of a simulated session: a room, a platform, props, and an object that deforms.

World: metres, z up, the origin on the floor in the middle of a 4 x 4 m room without a ceiling. The object
stands around (0, 0, 1). Every texture is attached to its mesh by texture coordinates, so it moves with the
surface; texture coordinate (0, 0) is the corner of the first texel of the picture's first row.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

ROOM_HALF_M = 2.0
ROOM_HEIGHT_M = 3.2  # of the walls, so that no camera looks over them
CENTRE = np.array([0.0, 0.0, 1.0])  # what every camera looks at
SHEET_WIDTH_M, SHEET_HEIGHT_M, SHEET_TOP_M = 0.9, 0.85, 1.45
COLUMN_RADIUS_M, COLUMN_HEIGHT_M, COLUMN_FOOT_M = 0.2, 0.95, 0.45
START_S = 0.4  # the motion grows to its full amplitude within this time


@dataclass(frozen=True)
class Paint:
    """Colours of a texture: sRGB of the ground (0 to 255), how far shapes differ from it, and how many."""

    tint: tuple[int, int, int]
    spread: float = 55.0
    density: float = 0.9


WALLS = (Paint((150, 165, 185)), Paint((185, 165, 140)), Paint((150, 180, 150)), Paint((180, 150, 170)))
FLOOR = Paint((140, 125, 110))
WOOD = Paint((165, 130, 95), spread=45.0)
BOXES = (Paint((110, 140, 170)), Paint((170, 170, 110)), Paint((150, 110, 110)), Paint((120, 150, 120)))
PRINT = Paint((205, 150, 95), spread=90.0, density=1.1)  # of the object: stands out from the room


@dataclass(frozen=True)
class Mesh:
    """A textured triangle mesh.

    Attributes:
        vertices: [V, 3], metres.
        faces: Vertex numbers [F, 3].
        uv: Texture coordinates [V, 2] in [0, 1].
        texture: sRGB picture [H, W, 3].
        smooth: Whether shading normals are interpolated.
        thickness_m: A sheet has a back, this far behind its front; 0 for closed surfaces.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "v 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    smooth: bool = False
    thickness_m: float = 0.0


@dataclass(frozen=True)
class MovingObject:
    """A mesh whose vertices are a function of time.

    Attributes:
        rest: The mesh at rest.
        vertices_at: Vertices [V, 3] at a time in seconds since the motion began; at rest before 0.
        stand: What holds it and does not move.
    """

    rest: Mesh
    vertices_at: Callable[[float], np.ndarray]
    stand: tuple[Mesh, ...]


def room(rng: np.random.Generator, contrast: float) -> list[Mesh]:
    """Four walls, a floor, a platform under the object and boxes in the corners."""
    h, top = ROOM_HALF_M, ROOM_HEIGHT_M
    corners = np.array([[h, -h], [h, h], [-h, h], [-h, -h]])
    meshes = []
    for i in range(4):  # each wall is seen from inside, its picture's rows going down
        a, b = corners[(i + 1) % 4], corners[i]
        quad = np.array([[*a, top], [*b, top], [*b, 0], [*a, 0]])
        meshes.append(_quad(quad, texture(rng, 533, 667, 0.006, contrast, paint=WALLS[i])))
    floor = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    meshes.append(_quad(floor, texture(rng, 667, 667, 0.006, contrast, paint=FLOOR)))
    meshes += box(rng, np.array([0.0, 0.0, 0.175]), np.array([1.15, 1.15, 0.35]), 8.0, contrast, WOOD)
    for i, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        size = rng.uniform([0.3, 0.3, 0.4 + 0.2 * i], [0.45, 0.45, 0.6 + 0.3 * i])
        centre = np.array([1.68 * x, 1.68 * y, size[2] / 2])
        meshes += box(rng, centre, size, rng.uniform(0, 90), contrast, BOXES[i])
    return meshes


def make_object(name: str, rng: np.random.Generator, contrast: float, motion_scale: float) -> MovingObject:
    """The deforming object of a scene: a name out of `OBJECTS`."""
    return OBJECTS[name](rng, contrast, motion_scale)


def _sheet(rng: np.random.Generator, contrast: float, motion_scale: float) -> MovingObject:
    """A cloth sheet that hangs from a bar and waves; every thread from top to bottom keeps its length."""
    rows, columns = 64, 68
    s = np.linspace(0, 1, rows)[:, None]  # along a thread, 0 at the bar
    y0 = np.linspace(-0.5, 0.5, columns)[None, :] * SHEET_WIDTH_M
    phases = rng.uniform(-0.4, 0.4, 4)

    def vertices_at(time_s: float) -> np.ndarray:
        amount = motion_scale * _smoothstep(time_s / START_S)
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
    cloth = texture(rng, 425, 450, 0.002, contrast, paint=PRINT, largest_m=0.16, smallest_m=0.035)
    rest = Mesh(vertices_at(0.0), faces[:, ::-1].copy(), uv, cloth, smooth=True, thickness_m=0.002)
    stand = []
    for side in (-1, 1):
        post = np.array([0.0, side * (SHEET_WIDTH_M / 2 + 0.04), (SHEET_TOP_M + 0.35) / 2 + 0.01])
        stand += box(rng, post, np.array([0.03, 0.03, SHEET_TOP_M - 0.33]), 0.0, contrast, WOOD)
    bar = np.array([0.0, 0.0, SHEET_TOP_M + 0.018])
    stand += box(rng, bar, np.array([0.035, SHEET_WIDTH_M + 0.14, 0.035]), 0.0, contrast, WOOD)
    return MovingObject(rest, vertices_at, tuple(stand))


def _column(rng: np.random.Generator, contrast: float, motion_scale: float) -> MovingObject:
    """A soft column on a plinth that bends, twists and is squashed; its foot does not move."""
    rows, around = 56, 72
    rise = np.linspace(0, np.pi / 2, 17)[1:]  # angle along the rounded top
    s = np.concatenate([np.linspace(0, 0.85, rows - 16), 0.85 + 0.15 * np.sin(rise)])[:, None]
    turn = np.linspace(np.pi, 3 * np.pi, around)[None, :]  # the seam, there twice, is behind
    phases = rng.uniform(-0.4, 0.4, 4)
    bulges = 1 + 0.10 * np.sin(2 * np.pi * 1.3 * s + 0.6) + 0.07 * np.cos(3 * turn + 2 * s)
    cap = np.concatenate([np.ones(rows - 16), np.cos(rise)])[:, None]
    radius = COLUMN_RADIUS_M * bulges * np.maximum(cap, 0.005)  # a last ring of 1 mm keeps its normals

    def vertices_at(time_s: float) -> np.ndarray:
        amount = motion_scale * _smoothstep(time_s / START_S)
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
    skin = texture(rng, 475, 628, 0.002, contrast, paint=PRINT, largest_m=0.16, smallest_m=0.035)
    rest = Mesh(vertices_at(0.0), faces, uv, skin, smooth=True)
    plinth = box(rng, np.array([0.0, 0.0, 0.4]), np.array([0.5, 0.5, 0.1]), 20.0, contrast, WOOD)
    return MovingObject(rest, vertices_at, tuple(plinth))


OBJECTS: dict[str, Callable[[np.random.Generator, float, float], MovingObject]] = {
    "sheet": _sheet,
    "column": _column,
}


def texture(
    rng: np.random.Generator,
    height: int,
    width: int,
    metres_per_texel: float,
    contrast: float,
    *,
    paint: Paint,
    largest_m: float = 0.5,
    smallest_m: float = 0.05,
) -> UInt8[np.ndarray, "h w 3"]:
    """A non-repeating sRGB picture: cloudy ground, then discs, polygons, rings and strokes of all sizes
    between `smallest_m` and `largest_m`, so that there are features at every distance."""
    ground = np.zeros((height, width, 3), np.float32)
    for octave in range(1, 6):
        cells = rng.uniform(-1, 1, (2**octave, 2**octave, 3)).astype(np.float32)
        ground += 0.25 * cv2.resize(cells, (width, height), interpolation=cv2.INTER_CUBIC)
    tint = np.array(paint.tint, np.float64)
    picture = np.clip(tint + paint.spread * ground, 0, 255).astype(np.uint8)
    area_m2 = height * width * metres_per_texel**2
    count = int(np.clip(paint.density * area_m2 / (smallest_m * largest_m), 12, 3000))
    sizes = np.sort(np.exp(rng.uniform(np.log(smallest_m), np.log(largest_m), count)))[::-1]
    for size in sizes / metres_per_texel:
        shade = np.clip(
            tint + paint.spread * rng.uniform(-1, 1, 3) + paint.spread * rng.uniform(-1, 1), 0, 255
        )
        colour = [int(c) for c in shade]
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        kind = rng.integers(4)
        if kind == 0:
            cv2.circle(picture, (int(x), int(y)), max(1, int(size / 2)), colour, -1, cv2.LINE_AA)
        elif kind == 1:
            angles = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(3, 7)))
            points = np.stack([x + size / 2 * np.cos(angles), y + size / 2 * np.sin(angles)], -1)
            cv2.fillPoly(picture, [points.astype(np.int32)], colour, cv2.LINE_AA)
        elif kind == 2:
            axes = (max(1, int(size / 2)), max(1, int(size * rng.uniform(0.15, 0.35))))
            cv2.ellipse(picture, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360, colour, -1, cv2.LINE_AA)
        else:
            ring = (int(x), int(y)), max(1, int(size / 2))
            cv2.circle(picture, *ring, colour, max(1, int(size / 5)), cv2.LINE_AA)
    flat = tint + contrast * (picture.astype(np.float32) - tint)
    return np.clip(flat.round(), 12, 243).astype(np.uint8)


def box(
    rng: np.random.Generator,
    centre: Float[np.ndarray, "3"],
    size: Float[np.ndarray, "3"],
    turn_deg: float,
    contrast: float,
    paint: Paint,
) -> list[Mesh]:
    """A textured box turned about the vertical."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    x, y, z = (
        np.array([c, s, 0]) * size[0] / 2,
        np.array([-s, c, 0]) * size[1] / 2,
        np.array([0, 0, size[2] / 2]),
    )
    sides = []
    for a, b in ((x, y), (y, -x), (-x, -y), (-y, x)):  # a points out of the side
        sides.append(
            np.stack([centre + a - b + z, centre + a + b + z, centre + a + b - z, centre + a - b - z])
        )
    sides.append(np.stack([centre - x + y + z, centre + x + y + z, centre + x - y + z, centre - x - y + z]))
    sides.append(np.stack([centre - x - y - z, centre + x - y - z, centre + x + y - z, centre - x + y - z]))
    meshes = []
    for quad in sides:
        width, height = np.linalg.norm(quad[1] - quad[0]), np.linalg.norm(quad[3] - quad[0])
        texel = 0.004
        shape = max(4, round(float(height) / texel)), max(4, round(float(width) / texel))
        picture = texture(rng, *shape, texel, contrast, paint=paint, largest_m=0.25, smallest_m=0.03)
        meshes.append(_quad(quad, picture))
    return meshes


def picture_on_quad(corners: Float[np.ndarray, "4 3"], picture: UInt8[np.ndarray, "h w 3"]) -> Mesh:
    """A flat picture; corners in the order top left, top right, bottom right, bottom left of the picture."""
    return _quad(corners, picture)


def _quad(corners: np.ndarray, picture: np.ndarray) -> Mesh:
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Mesh(corners.astype(np.float64), np.array([[0, 2, 1], [0, 3, 2]]), uv, picture)


def _grid(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces and texture coordinates of a grid of vertices, row by row."""
    n = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (q.ravel() for q in (n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]))
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]), np.stack([u, v], -1).reshape(
        -1, 2
    )


def _smoothstep(x: float) -> float:
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)
