"""What surfaces look like from near: wood, plaster, cloth, skin, hair, a pegboard with tools, a sky.

Each material is a function of a random generator, a shape (rows, columns), the size of a texel in metres and an sRGB
colour (0 to 255); it returns a float picture [H, W, 3] on that scale, not yet clipped.
"""

import cv2
import numpy as np
from jaxtyping import Float

Rng = np.random.Generator
Shape = tuple[int, int]
Tint = tuple[int, int, int]
Picture = Float[np.ndarray, "h w 3"]

HAIR, LIP, EYE = (52, 36, 26), (150, 82, 74), (38, 30, 28)
TOOLS = (  # metal and grip of each, centimetres
    ([(-4.5, 0), (5, 0), (5, 3), (-4.5, 3.5)], [(-1, 3), (1.2, 3), (1.5, 26), (-1.4, 26)]),
    ([(-3.5, 9), (4, 9), (1.5, 28), (-1.5, 28)], [(-4, 0), (3, 0), (4.5, 10), (-4.5, 10)]),
    ([(-2, 0), (0, 2), (2, 0), (2, 3), (1, 5), (1.2, 22), (-1.2, 22), (-1, 5), (-2, 3)],),
    ([(-0.5, 10), (0.5, 10), (0.3, 25), (-0.3, 25)], [(-1.6, 0), (1.6, 0), (1.2, 11), (-1.2, 11)]),
    ([(-5, 0), (-2, 0), (-2, 20), (6, 20), (6, 22.5), (-5, 22.5)],),
)
SKY_TOP, SKY_LOW = (104, 156, 214), (222, 234, 243)


def noise(rng: Rng, shape: Shape, rows: float | int, columns: float | int) -> Float[np.ndarray, "h w"]:
    """Smooth random values of about unit variance whose grains are so many texels high and wide."""
    cells = max(2, round(shape[0] / rows) + 1), max(2, round(shape[1] / columns) + 1)
    grid = rng.normal(0, 1, cells).astype(np.float32)
    return cv2.resize(grid, shape[::-1], interpolation=cv2.INTER_CUBIC)


def wood(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Rings cut lengthwise, pores and scratches; the grain runs along the longer side."""
    if shape[0] > shape[1]:
        return wood(rng, (shape[1], shape[0]), texel_m, tint).transpose(1, 0, 2)
    across = np.arange(shape[0], dtype=np.float32)[:, None] * texel_m
    bent = across + 0.012 * noise(rng, shape, 0.06 / texel_m, 0.5 / texel_m)
    rings = np.sin(2 * np.pi * bent / 0.021 + 1.5 * noise(rng, shape, 0.03 / texel_m, 0.3 / texel_m))
    pores = noise(rng, shape, 1, 0.05 / texel_m)
    shade = 9 * rings + 7 * pores + 8 * noise(rng, shape, 0.08 / texel_m, 0.25 / texel_m)
    return _worn(rng, np.array(tint) + shade[..., None] * [1.0, 0.85, 0.65], texel_m)


def planks(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Boards along the rows, 0.13 m wide, with dark joints."""
    step = max(3, round(0.13 / texel_m))
    rows = []
    for start in range(0, shape[0], step):
        board = wood(rng, (min(step, shape[0] - start), shape[1]), texel_m, tint) + rng.uniform(-20, 14)
        board[0] *= 0.45
        end = int(rng.integers(shape[1]))
        board[:, end : end + 1] *= 0.5
        rows.append(board)
    return np.concatenate(rows)


def plaster(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Uneven paint, marks of the trowel and fine bumps that are lit from the side."""
    shade = 3 * noise(rng, shape, 0.5 / texel_m, 0.5 / texel_m) + 3 * noise(
        rng, shape, 0.05 / texel_m, 0.12 / texel_m
    )
    bumps = noise(rng, shape, 0.012 / texel_m, 0.012 / texel_m)
    shade += 7 * (bumps - np.roll(bumps, 1, axis=1)) + 2 * noise(rng, shape, 1, 1)
    stains = np.clip(noise(rng, shape, 0.25 / texel_m, 0.1 / texel_m) - 1.3, 0, 1)
    return np.array(tint) + shade[..., None] - stains[..., None] * [5.0, 7.0, 11.0]


def painted(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Paint on wood or metal: brush strokes, worn edges and scratches."""
    long = (1.0, 0.2 / texel_m) if shape[1] >= shape[0] else (0.2 / texel_m, 1.0)
    shade = 3 * noise(rng, shape, *long) + 5 * noise(rng, shape, 0.1 / texel_m, 0.1 / texel_m)
    return _worn(rng, np.array(tint) + shade[..., None], texel_m)


def plaid(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """A woven shirt: stripes both ways, threads and creases."""
    return _woven(rng, shape, texel_m, tint, 0.17, 0.42)


def twill(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Worn jeans: diagonal threads, light where they are rubbed."""
    rubbed = 12 * noise(rng, shape, 0.2 / texel_m, 0.12 / texel_m) + 6 * noise(
        rng, shape, 0.03 / texel_m, 0.03 / texel_m
    )
    i, j = np.indices(shape)
    return np.array(tint) + (rubbed + 5 * np.sin(2.1 * (i + j)) + 5 * noise(rng, shape, 3, 1))[..., None]


def linen(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """A tea towel: a light ground with few coloured stripes."""
    return _woven(rng, shape, texel_m, tint, 0.3, 0.3)


def skin(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Blotches and freckles."""
    red = noise(rng, shape, 0.08 / texel_m, 0.08 / texel_m)
    freckles = np.clip(noise(rng, shape, 1.5, 1.5) - 1.0, 0, 1)
    shade = 4 * noise(rng, shape, 0.03 / texel_m, 0.03 / texel_m) - 32 * freckles
    return np.array(tint) + shade[..., None] * [0.7, 1.0, 1.0] + red[..., None] * [3.0, -3.0, -3.0]


def hair(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Strands from top to bottom."""
    strands = 14 * noise(rng, shape, shape[0] / 3, 1.5) + 7 * noise(rng, shape, 4, 4)
    return np.array(tint) + strands[..., None] * [1.0, 0.8, 0.6]


def head(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """A face for a turned ball, whose rows go up and whose first column looks ahead; hair above and behind."""
    rows, columns = shape
    picture, strands = skin(rng, shape, texel_m, tint), hair(rng, shape, texel_m, HAIR)
    up = np.linspace(0, 1, rows)[:, None]
    around = np.abs(np.linspace(-1, 1, columns))[None, :]  # 0 ahead, 1 behind
    line = 0.74 - 0.42 * np.clip((around - 0.25) / 0.3, 0, 1) + 0.02 * noise(rng, (1, columns), 1, 3)
    covered = np.clip((up - line) * rows / 2 + 0.5, 0, 1)[..., None]
    picture = (1 - covered) * picture + covered * strands

    def spot(right: float, rise: float, wide: float, high: float, colour: Tint) -> None:
        middle = round((0.5 + right / 2) * columns), round(rise * rows)
        axes = max(1, round(wide * columns / 2)), max(1, round(high * rows))
        cv2.ellipse(picture, middle, axes, 0, 0, 360, colour, -1, cv2.LINE_AA)

    picture = np.ascontiguousarray(picture, dtype=np.float32)
    for side in (-1, 1):
        spot(0.13 * side, 0.57, 0.05, 0.02, (232, 226, 218))
        spot(0.13 * side, 0.57, 0.025, 0.02, EYE)
        spot(0.13 * side, 0.66, 0.06, 0.008, HAIR)
        spot(0.2 * side, 0.42, 0.09, 0.07, (206, 138, 112))
    spot(0.0, 0.33, 0.09, 0.015, LIP)
    return np.roll(picture, columns // 2, axis=1)


def pegboard(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """A board with holes; on it hang hammers, saws, keys, files and squares, each with its shadow."""
    picture = np.ascontiguousarray(painted(rng, shape, texel_m, tint), dtype=np.float32)
    step = max(3, round(0.03 / texel_m))
    for y in range(step // 2, shape[0], step):
        for x in range(step // 2, shape[1], step):
            cv2.circle(picture, (x, y), max(1, round(0.004 / texel_m)), (52, 44, 36), -1, cv2.LINE_AA)
    mask, colours = np.zeros(shape, np.float32), np.zeros_like(picture)
    slots = max(1, round(shape[1] * texel_m / 0.14))
    for row in range(max(1, round(shape[0] * texel_m / 0.36))):
        for slot in range(slots):
            x, y = 0.14 * slot + 0.07 + rng.uniform(-0.015, 0.015), 0.36 * row + 0.06
            _tool(
                rng,
                mask,
                colours,
                int(rng.integers(len(TOOLS))),
                (x / texel_m, y / texel_m),
                rng.uniform(0.85, 1.1) / texel_m,
            )
    away = max(1, round(0.008 / texel_m))
    shadow = cv2.GaussianBlur(np.roll(mask, (2 * away, away), (0, 1)), (0, 0), max(0.6, away / 1.5))
    lit = picture * (1 - 0.5 * shadow[..., None])
    return lit + mask[..., None] * (colours + 9 * noise(rng, shape, 2, 2)[..., None] - lit)


def sky(rng: Rng, shape: Shape, texel_m: float, tint: Tint) -> Picture:
    """Blue above, hazy below, with clouds; trees at the lower edge, of the colour that is given."""
    up = np.linspace(1, 0, shape[0])[:, None, None]
    cloud = sum(noise(rng, shape, shape[0] / n, shape[1] / n) / n for n in (3, 6, 12, 24))
    cloud = np.clip(1.6 * np.asarray(cloud) - 0.1, 0, 1)[..., None]
    picture = (1 - cloud) * (np.array(SKY_LOW) * (1 - up) + np.array(SKY_TOP) * up) + cloud * 246
    crowns = 0.3 + 0.05 * noise(rng, (1, shape[1]), 1, shape[1] / 9) + 0.02 * noise(rng, (1, shape[1]), 1, 4)
    leaves = (
        np.array(tint) + 22 * noise(rng, shape, 6, 6)[..., None] + 18 * noise(rng, shape, 2, 2)[..., None]
    )
    return np.where(up < crowns[..., None], leaves, picture)


def _tool(
    rng: Rng, mask: np.ndarray, colours: np.ndarray, kind: int, top: tuple[float, float], m: float
) -> None:
    """Draw one that hangs below a place; `m` is a metre in texels."""
    handles = ((150, 96, 52), (168, 40, 34), (34, 74, 128), (196, 150, 40))
    grip, steel = handles[rng.integers(4)], int(rng.integers(120, 175))
    metal = (steel, steel + 3, steel + 8)
    for outline, colour in zip(TOOLS[kind], (metal, grip), strict=False):
        points = np.round(np.array(top) + m / 100 * np.array(outline)).astype(np.int32)
        cv2.fillPoly(mask, [points], 1.0, cv2.LINE_AA)
        cv2.fillPoly(colours, [points], colour)


def _woven(rng: Rng, shape: Shape, texel_m: float, tint: Tint, period_m: float, depth: float) -> np.ndarray:
    """Threads of a colour with darker and lighter stripes both ways."""
    light, dark = np.array(tint) + 0.55 * (250 - np.array(tint)), np.array(tint) * (1 - depth)
    picture = np.broadcast_to(np.array(tint, np.float32), (*shape, 3)).copy()
    for axis in (0, 1):
        at = np.arange(shape[axis]) * texel_m / period_m % 1.0
        wide, fine = (
            ((at > 0.1) & (at < 0.45)).astype(np.float32),
            ((at > 0.7) & (at < 0.78)).astype(np.float32),
        )
        for line, colour, share in ((wide, dark, 0.55), (fine, light, 0.6)):
            amount = share * (line[:, None, None] if axis == 0 else line[None, :, None])
            picture += amount * (colour - picture)
    creases = 7 * noise(rng, shape, 0.25 / texel_m, 0.08 / texel_m)
    return picture + (creases + 4 * noise(rng, shape, 1, 3) + 4 * noise(rng, shape, 3, 1))[..., None]


def _worn(rng: Rng, picture: np.ndarray, texel_m: float) -> np.ndarray:
    """With light edges, as if they were bevelled and rubbed, and a few scratches."""
    rows, columns = picture.shape[:2]
    picture = np.ascontiguousarray(picture, dtype=np.float32)
    for _ in range(int(14 * rows * columns * texel_m**2)):
        start = rng.uniform(0, 1, 2) * [columns, rows]
        end = start + rng.uniform(0.02, 0.12) / texel_m * np.array(
            [np.cos(a := rng.uniform(0, 6.3)), np.sin(a)]
        )
        colour = picture[int(start[1]), int(start[0])] + rng.choice([-24.0, 26.0])
        cv2.line(
            picture,
            tuple(start.astype(int).tolist()),
            tuple(end.astype(int).tolist()),
            colour.tolist(),
            1,
            cv2.LINE_AA,
        )
    picture[:1] += 16
    picture[:, :1] += 10
    picture[-1:] -= 14
    picture[:, -1:] -= 8
    return picture
