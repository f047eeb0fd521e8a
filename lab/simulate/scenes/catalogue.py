"""Shapes and textures of a simulated session: a room, a platform and props.

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
PLATFORM_M = 0.35  # height of what the object stands on


@dataclass(frozen=True)
class Paint:
    """Colours of a texture: sRGB of the ground (0 to 255), how far shapes differ from it, and how many.

    With a `surface`, one of `materials`, it looks like that instead of being covered with shapes.
    """

    tint: tuple[int, int, int]
    spread: float = 55.0
    density: float = 0.9
    surface: (
        Callable[[np.random.Generator, tuple[int, int], float, tuple[int, int, int]], np.ndarray] | None
    ) = None


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
        light: Even light on it, where it differs from place to place (`render.daylight`): radiance of a white surface,
            a coarse picture over the same texture coordinates; None: the same everywhere.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    uv: Float[np.ndarray, "v 2"]
    texture: UInt8[np.ndarray, "h w 3"]
    smooth: bool = False
    thickness_m: float = 0.0
    light: Float[np.ndarray, "lh lw 3"] | None = None


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


@dataclass(frozen=True)
class Room:
    """Where the object stands.

    Attributes:
        still: Four walls, a floor, a platform under the object, and boxes in the corners behind the fixed cameras.
        behind: The boxes in the other two corners, which the fixed cameras see behind the object.
    """

    still: list[Mesh]
    behind: list[Mesh]


def room(rng: np.random.Generator, contrast: float) -> Room:
    """The same room for the same random numbers."""
    h, top = ROOM_HALF_M, ROOM_HEIGHT_M
    corners = np.array([[h, -h], [h, h], [-h, h], [-h, -h]])
    meshes, behind = [], []
    for i in range(4):  # each wall is seen from inside, its picture's rows going down
        a, b = corners[(i + 1) % 4], corners[i]
        quad = np.array([[*a, top], [*b, top], [*b, 0], [*a, 0]])
        meshes.append(_quad(quad, texture(rng, (533, 667), 0.006, contrast, paint=WALLS[i])))
    floor = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
    meshes.append(_quad(floor, texture(rng, (667, 667), 0.006, contrast, paint=FLOOR)))
    meshes += box(
        rng, np.array([0.0, 0.0, PLATFORM_M / 2]), np.array([1.15, 1.15, PLATFORM_M]), 8.0, contrast, WOOD
    )
    for i, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        size = rng.uniform([0.3, 0.3, 0.4 + 0.2 * i], [0.45, 0.45, 0.6 + 0.3 * i])
        centre = np.array([1.68 * x, 1.68 * y, size[2] / 2])
        (meshes if x > 0 else behind).extend(box(rng, centre, size, rng.uniform(0, 90), contrast, BOXES[i]))
    return Room(meshes, behind)


def texture(
    rng: np.random.Generator,
    shape: tuple[int, int],
    metres_per_texel: float,
    contrast: float,
    *,
    paint: Paint,
    sizes_m: tuple[float, float] = (0.05, 0.5),
) -> UInt8[np.ndarray, "h w 3"]:
    """A non-repeating sRGB picture: cloudy ground, then discs, polygons, rings and strokes of all sizes
    between those of `sizes_m`, so that there are features at every distance; or the paint's own surface."""
    (height, width), (smallest_m, largest_m) = shape, sizes_m
    if paint.surface is not None:
        picture = paint.surface(rng, shape, metres_per_texel, paint.tint)
        return _with_contrast(picture.astype(np.float32), np.array(paint.tint, np.float64), contrast)
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
    return _with_contrast(picture.astype(np.float32), tint, contrast)


def _with_contrast(picture: np.ndarray, tint: np.ndarray, contrast: float) -> np.ndarray:
    return np.clip((tint + contrast * (picture - tint)).round(), 12, 243).astype(np.uint8)


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
    x = np.array([c, s, 0]) * size[0] / 2
    y = np.array([-s, c, 0]) * size[1] / 2
    z = np.array([0, 0, size[2] / 2])
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
        picture = texture(rng, shape, texel, contrast, paint=paint, sizes_m=(0.03, 0.25))
        meshes.append(_quad(quad, picture))
    return meshes


def picture_on_quad(corners: Float[np.ndarray, "4 3"], picture: UInt8[np.ndarray, "h w 3"]) -> Mesh:
    """A flat picture; corners in the order top left, top right, bottom right, bottom left of the picture."""
    return _quad(corners, picture)


def _quad(corners: np.ndarray, picture: np.ndarray) -> Mesh:
    uv = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Mesh(corners.astype(np.float64), np.array([[0, 2, 1], [0, 3, 2]]), uv, picture)
