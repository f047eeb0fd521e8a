"""Furnished rooms of a simulated session: plain walls, and what people put before them.

The room of `scenes.room` is patterned all over, which is easy to recover. Real rooms are not: plain walls, furniture
at some distance from them, a window that shows what is far away, things that stand close to a camera. Axes and
lengths are those of `scenes`. The moving camera goes round at 1.5 m from the middle, at heights of about 0.95 and
1.6 m, the fixed cameras stand at most 1.7 m from it: what is as far as they are from the middle ends below 0.75 m.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from devrf.lab.simulate.scenes.catalogue import (
    PLATFORM_M,
    ROOM_HALF_M,
    ROOM_HEIGHT_M,
    Mesh,
    Paint,
    Room,
    picture_on_quad,
    texture,
)

Tint = tuple[int, int, int]
Picture = UInt8[np.ndarray, "h w 3"]

TEXEL_M = 0.006
WALLS: tuple[Tint, ...] = ((206, 201, 190), (198, 203, 204), (209, 203, 196), (200, 198, 190))
OAK, WALNUT, WHITE, STEEL = (176, 142, 104), (112, 80, 58), (221, 219, 214), (128, 132, 138)
SKY, GARDEN = (222, 232, 241), Paint((96, 128, 78), spread=60.0, density=1.3)
RUG, CANVAS = Paint((140, 70, 62), spread=60.0), Paint((150, 140, 120), spread=80.0, density=1.2)
SPINES: tuple[Tint, ...] = (
    (142, 44, 40),
    (38, 70, 110),
    (60, 96, 62),
    (190, 160, 84),
    (70, 62, 74),
    (196, 188, 172),
    (88, 50, 84),
)


def furnished(kind: str, rng: np.random.Generator, contrast: float) -> Room:
    """A furnished room; the same for the same random numbers.

    Args:
        kind: One out of `ROOMS`.
        rng: Decides where things stand, and their patterns.
        contrast: Of all patterns; 1 is as they are.
    """
    meshes, behind = ROOMS[kind](rng)
    return Room([_with_contrast(m, contrast) for m in meshes], [_with_contrast(m, contrast) for m in behind])


def _shelves(rng: np.random.Generator) -> tuple[list[Mesh], list[Mesh]]:
    """Plain walls, a bookcase behind the object, a sideboard, a painting and a rug."""
    h = ROOM_HALF_M
    meshes = [*_walls(rng, h, h), _floor(rng, h, h), *_table(rng), _rug(rng, (2.9, 2.0))]
    meshes += _bookcase(rng, y=rng.uniform(-0.25, 0.25), width=1.7, boards=5)
    meshes += _sideboard(rng, x=rng.uniform(-0.4, 0.2), y=h - 0.2)
    meshes += _painting(rng, x=rng.uniform(-0.6, 0.2), y=-h + 0.02)
    meshes += _solid(rng, (1.72, -1.5, 0.3), (0.4, 0.4, 0.6), 20, OAK)
    return meshes, _solid(rng, (-1.5, -1.62, 0.28), (0.42, 0.42, 0.56), rng.uniform(0, 60), WALNUT)


def _window(rng: np.random.Generator) -> tuple[list[Mesh], list[Mesh]]:
    """A window behind the object shows a garden far away; curtains beside it, a low bench under it."""
    h, (low, high), half = ROOM_HALF_M, (0.9, 2.35), 0.85
    middle = rng.uniform(-0.2, 0.2)
    meshes = [*_walls(rng, h, h, leave_out=(2,)), _floor(rng, h, h), *_table(rng), _rug(rng, (2.4, 2.6))]
    for (y0, y1), (z0, z1) in (
        ((-h, middle - half), (0.0, ROOM_HEIGHT_M)),
        ((middle + half, h), (0.0, ROOM_HEIGHT_M)),
        ((middle - half, middle + half), (0.0, low)),
        ((middle - half, middle + half), (high, ROOM_HEIGHT_M)),
    ):
        meshes.append(_facing_x(-h, (y0, y1), (z0, z1), _plain(rng, z1 - z0, y1 - y0, WALLS[2])))
    meshes.append(_facing_x(-h - 4.5, (-7.0, 7.0), (-2.5, 6.0), _outside(rng)))
    for y in (middle - half, middle, middle + half):
        meshes += _solid(rng, (-h, y, (low + high) / 2), (0.08, 0.06, high - low), 0, WHITE)
    for z in (low, (low + high) / 2, high):
        meshes += _solid(rng, (-h, middle, z), (0.09, 2 * half, 0.05), 0, WHITE)
    meshes += [_curtain(rng, middle + side * (half + 0.12), 2.6) for side in (-1, 1)]
    meshes += _solid(rng, (-h + 0.25, middle, 0.22), (0.4, 1.5, 0.44), 0, OAK)
    meshes += _painting(rng, x=rng.uniform(-0.5, 0.3), y=-h + 0.02)
    meshes += _sideboard(rng, x=rng.uniform(-0.5, 0.3), y=h - 0.2)
    return meshes, _solid(rng, (-1.5, 1.45, 0.35), (0.36, 0.36, 0.7), rng.uniform(0, 60), STEEL)


def _narrow(rng: np.random.Generator) -> tuple[list[Mesh], list[Mesh]]:
    """Walls close behind the fixed cameras, an armchair, a cupboard and a lamp close before them."""
    h, side = ROOM_HALF_M, 1.76
    meshes = [*_walls(rng, h, side), _floor(rng, h, side), *_table(rng), _rug(rng, (3.2, 1.4))]
    meshes += _bookcase(rng, y=rng.uniform(-0.9, -0.7), width=0.9, boards=6)
    meshes += _armchair(rng, (0.78, -1.02), rng.uniform(40, 60))
    meshes += _armchair(rng, (-0.75, 1.1), rng.uniform(200, 230))
    meshes += _solid(rng, (1.25, side - 0.12, 0.36), (0.6, 0.24, 0.72), 0, WALNUT)
    meshes += _solid(rng, (0.1, side - 0.08, 1.35), (0.7, 0.14, 0.03), 0, OAK)
    meshes += _books(
        rng,
        np.array([0.1 - 0.2, side - 0.03, 1.365]),
        np.array([1.0, 0, 0]),
        np.array([0, -1.0, 0]),
        0.4,
        0.1,
    )
    # the lamp, half a metre before a camera
    meshes += _solid(rng, (0.74, 1.04, 0.6), (0.03, 0.03, 1.2), 0, STEEL)
    meshes += _solid(rng, (0.74, 1.04, 1.3), (0.16, 0.16, 0.2), 45, WHITE)
    meshes += _painting(rng, x=rng.uniform(-0.9, -0.5), y=-side + 0.02)
    return meshes, _solid(rng, (-1.6, 1.35, 0.45), (0.4, 0.4, 0.9), rng.uniform(0, 30), OAK)


ROOMS: dict[str, Callable[[np.random.Generator], tuple[list[Mesh], list[Mesh]]]] = {
    "shelves": _shelves,
    "window": _window,
    "narrow": _narrow,
}


def _walls(rng: np.random.Generator, x: float, y: float, leave_out: tuple[int, ...] = ()) -> list[Mesh]:
    """Four plain walls seen from inside (+x, +y, -x, -y) with skirting boards."""
    corners, top = np.array([[x, -y], [x, y], [-x, y], [-x, -y]]), ROOM_HEIGHT_M
    meshes = []
    for i in range(4):
        a, b = corners[(i + 1) % 4], corners[i]
        length, inward = float(np.linalg.norm(b - a)), -0.012 * (a + b) / np.linalg.norm(a + b)
        if i not in leave_out:
            quad = np.array([[*a, top], [*b, top], [*b, 0], [*a, 0]])
            meshes.append(picture_on_quad(quad, _plain(rng, top, length, WALLS[i])))
        a, b = a + inward, b + inward
        quad = np.array([[*a, 0.08], [*b, 0.08], [*b, 0], [*a, 0]])
        meshes.append(picture_on_quad(quad, _plain(rng, 0.08, length, WHITE)))
    return meshes


def _floor(rng: np.random.Generator, x: float, y: float) -> Mesh:
    """Planks along x, 0.12 m wide."""
    rows = []
    while sum(len(row) for row in rows) < 2 * y / TEXEL_M:
        shade = np.array(OAK) + rng.uniform(-22, 12)
        row = _grain(rng, 0.12, 2 * x, (int(shade[0]), int(shade[1]), int(shade[2])))
        row[0] = row[:, int(rng.integers(row.shape[1]))] = (70, 54, 40)
        rows.append(row)
    quad = np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]])
    return picture_on_quad(quad, np.concatenate(rows))


def _rug(rng: np.random.Generator, size: tuple[float, float]) -> Mesh:
    """Larger than any scene box round the object, so that its side cuts it."""
    (x, y), (width, depth) = rng.uniform(-0.1, 0.1, 2), size
    picture = texture(
        rng, (round(depth / TEXEL_M), round(width / TEXEL_M)), TEXEL_M, 1.0, paint=RUG, sizes_m=(0.05, 0.35)
    )
    for at in (0.06, 0.12):
        edge = round(at / TEXEL_M)
        cv2.rectangle(
            picture, (edge, edge), (picture.shape[1] - edge, picture.shape[0] - edge), (214, 196, 150), 3
        )
    a, b, z = width / 2, depth / 2, 0.008
    return picture_on_quad(
        np.array([[x - a, y + b, z], [x + a, y + b, z], [x + a, y - b, z], [x - a, y - b, z]]), picture
    )


def _table(rng: np.random.Generator) -> list[Mesh]:
    """What the object stands on."""
    return _solid(rng, (0, 0, PLATFORM_M / 2), (1.15, 1.15, PLATFORM_M), 8.0, WALNUT)


def _bookcase(rng: np.random.Generator, y: float, width: float, boards: int) -> list[Mesh]:
    """Against the wall at -x: sides, boards and a back, full of books."""
    depth, step, x = 0.28, 0.36, -ROOM_HALF_M
    top = step * (boards - 1) + 0.06
    meshes = _solid(rng, (x + 0.02, y, top / 2), (0.03, width, top), 0, WALNUT)
    for side in (-1, 1):
        meshes += _solid(rng, (x + depth / 2, y + side * width / 2, top / 2), (depth, 0.03, top), 0, OAK)
    for n in range(boards):
        meshes += _solid(rng, (x + depth / 2, y, 0.04 + n * step), (depth, width, 0.025), 0, OAK)
        if n < boards - 1:
            start = np.array([x + 0.04, y - width / 2 + 0.03, 0.053 + n * step])
            filled = (width - 0.06) * rng.uniform(0.6, 0.95)
            meshes += _books(rng, start, np.array([0, 1.0, 0]), np.array([1.0, 0, 0]), filled, 0.19)
    return meshes


def _books(
    rng: np.random.Generator,
    start: np.ndarray,
    along: np.ndarray,
    out: np.ndarray,
    length: float,
    depth: float,
) -> list[Mesh]:
    """A row of books from `start` on: spines face `out`."""
    meshes, at = [], 0.0
    while at < length:
        thick, tall, deep = rng.uniform(0.018, 0.055), rng.uniform(0.17, 0.29), depth * rng.uniform(0.8, 1.0)
        tint = np.array(SPINES[rng.integers(len(SPINES))]) + rng.integers(-15, 15)
        centre = start + along * (at + thick / 2) + out * deep / 2 + [0, 0, tall / 2]
        size = np.abs(along) * (thick - 0.002) + np.abs(out) * deep + [0, 0, tall]
        book = _solid(rng, tuple(centre), tuple(size), 0, (int(tint[0]), int(tint[1]), int(tint[2])))
        for mesh in book:  # a title on every side is as good as on the spine alone
            rows, columns = mesh.texture.shape[:2]
            cv2.rectangle(
                mesh.texture, (0, int(rows * 0.2)), (columns, int(rows * 0.2 + rng.uniform(1, rows / 4))),
                [int(c) for c in rng.uniform(150, 235, 3)], -1,
            )  # fmt: skip
        meshes += [
            mesh
            for mesh in book
            if _outward(mesh) @ out > 0.5 or _outward(mesh)[2] > 0.5 or at == 0.0 or at + thick >= length
        ]
        at += thick
    return meshes


def _sideboard(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """With a vase and two boxes on it."""
    meshes = _solid(rng, (x, y, 0.36), (1.3, 0.38, 0.72), 0, WHITE)
    for mesh in meshes:
        rows, columns = mesh.texture.shape[:2]
        for share in (0.33, 0.66):
            cv2.line(
                mesh.texture, (int(columns * share), 0), (int(columns * share), rows), (120, 118, 112), 1
            )
    for shift, size, tint in (
        (-0.4, (0.14, 0.14, 0.3), STEEL),
        (0.1, (0.24, 0.18, 0.12), (150, 74, 60)),
        (0.42, (0.2, 0.2, 0.2), (70, 98, 120)),
    ):
        place = (x + shift + rng.uniform(-0.05, 0.05), y, 0.72 + size[2] / 2)
        meshes += _solid(rng, place, size, rng.uniform(0, 45), tint)
    return meshes


def _painting(rng: np.random.Generator, x: float, y: float) -> list[Mesh]:
    """In a frame on the wall at y; seen from the middle of the room."""
    to_wall = np.sign(y)
    canvas = texture(rng, (110, 150), TEXEL_M, 1.0, paint=CANVAS, sizes_m=(0.03, 0.3))
    cv2.rectangle(canvas, (0, 0), (149, 109), (58, 44, 34), 8)
    a, b = to_wall * 0.45, 0.33
    corners = np.array(
        [[x - a, y, 1.55 + b], [x + a, y, 1.55 + b], [x + a, y, 1.55 - b], [x - a, y, 1.55 - b]]
    )
    return [picture_on_quad(corners, canvas)]


def _armchair(rng: np.random.Generator, place: tuple[float, float], turn_deg: float) -> list[Mesh]:
    """Seat, back and two arms; no higher than 0.72 m."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    meshes = []
    for (x, y, z), size in (
        ((0, 0, 0.2), (0.5, 0.5, 0.4)),
        ((-0.24, 0, 0.36), (0.12, 0.5, 0.72)),
        ((0, 0.28, 0.28), (0.5, 0.1, 0.56)),
        ((0, -0.28, 0.28), (0.5, 0.1, 0.56)),
    ):
        centre = (place[0] + c * x - s * y, place[1] + s * x + c * y, z)
        meshes += _solid(rng, centre, size, turn_deg, (86, 110, 122))
    return meshes


def _curtain(rng: np.random.Generator, y: float, height: float) -> Mesh:
    """Hangs in folds before the wall at -x, 0.4 m wide."""
    folds = 40
    across = np.linspace(-0.2, 0.2, folds)
    x = -ROOM_HALF_M + 0.1 + 0.03 * np.sin(across * 90 + rng.uniform(0, 6))
    vertices = np.array([[x[i], y + across[i], z] for z in (height, 0.05) for i in range(folds)])
    uv = np.array([[i / (folds - 1), v] for v in (0.0, 1.0) for i in range(folds)])
    faces = [f for i in range(folds - 1) for f in ((i, i + folds + 1, i + 1), (i, i + folds, i + folds + 1))]
    stripes = _plain(rng, height, 0.4, (170, 160, 178))
    stripes[:, ::9] = (138, 120, 146)
    return Mesh(vertices, np.array(faces), uv, stripes, smooth=True)


def _outside(rng: np.random.Generator) -> Picture:
    """A garden under a bright sky."""
    picture = texture(rng, (425, 700), 0.02, 1.0, paint=GARDEN, sizes_m=(0.1, 1.5))
    horizon = 215 + (12 * np.cumsum(rng.normal(0, 0.35, 700))).clip(-60, 60)
    above = np.arange(425)[:, None] < horizon
    sky = _plain(rng, 425 * TEXEL_M, 700 * TEXEL_M, SKY)
    return np.where(above[..., None], sky, picture)


def _solid(
    rng: np.random.Generator,
    centre: tuple[float | int, ...],
    size: tuple[float | int, ...],
    turn_deg: float | int,
    tint: Tint,
) -> list[Mesh]:
    """A plain or wooden box turned about the vertical, without its bottom."""
    c, s = np.cos(np.radians(turn_deg)) / 2, np.sin(np.radians(turn_deg)) / 2
    x, y, z = size[0] * np.array([c, s, 0]), size[1] * np.array([-s, c, 0]), np.array([0, 0, size[2] / 2])
    middle, meshes = np.array(centre), []
    for a, b, up in ((x, y, z), (y, -x, z), (-x, -y, z), (-y, x, z), (z, y, -x)):  # a points out
        quad = np.stack([middle + a - b + up, middle + a + b + up, middle + a + b - up, middle + a - b - up])
        width, height = 2 * np.linalg.norm(b), 2 * np.linalg.norm(up)
        wooden = tint in (OAK, WALNUT)
        meshes.append(picture_on_quad(quad, (_grain if wooden else _plain)(rng, height, width, tint)))
    return meshes


def _outward(mesh: Mesh) -> Float[np.ndarray, "3"]:
    a, b, c, _ = mesh.vertices
    normal = np.cross(c - b, b - a)
    return normal / np.linalg.norm(normal)


def _plain(rng: np.random.Generator, height: float, width: float, tint: Tint) -> Picture:
    """One colour, and what any wall has of shade: two levels over its width."""
    shape = max(4, round(height / TEXEL_M)), max(4, round(width / TEXEL_M))
    cloud = cv2.resize(
        rng.uniform(-1, 1, (4, 4)).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC
    )
    return np.clip(np.array(tint) + 2 * cloud[..., None], 12, 243).round().astype(np.uint8)


def _grain(rng: np.random.Generator, height: float, width: float, tint: Tint) -> Picture:
    """Wood, its grain along the longer side."""
    shape = max(4, round(height / TEXEL_M)), max(4, round(width / TEXEL_M))
    long = shape[1] >= shape[0]
    cells = (max(4, shape[0] // 2), 6) if long else (6, max(4, shape[1] // 2))
    streaks = cv2.resize(
        rng.normal(0, 1, cells).astype(np.float32), shape[::-1], interpolation=cv2.INTER_LINEAR
    )
    return np.clip(np.array(tint) + 9 * streaks[..., None], 12, 243).round().astype(np.uint8)


def _facing_x(x: float, y: tuple[float, float], z: tuple[float, float], picture: Picture) -> Mesh:
    """A picture in the plane at x, seen from +x."""
    (y0, y1), (z0, z1) = y, z
    return picture_on_quad(np.array([[x, y0, z1], [x, y1, z1], [x, y1, z0], [x, y0, z0]]), picture)


def _with_contrast(mesh: Mesh, contrast: float) -> Mesh:
    if contrast == 1:
        return mesh
    mean = mesh.texture.reshape(-1, 3).mean(axis=0)
    flat = np.clip(mean + contrast * (mesh.texture - mean), 12, 243).round().astype(np.uint8)
    return Mesh(mesh.vertices, mesh.faces, mesh.uv, flat, mesh.smooth, mesh.thickness_m)
