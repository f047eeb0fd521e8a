"""How far a picture lies beside another one of the same scene, found without knowing why.

The pictures are cut into blocks. Every block of the first is looked for in the second by normalised correlation
(Lewis, Fast Normalized Cross-Correlation, 1995), which asks for neither the same exposure nor the same contrast, and
its peak is read between pixels by a parabola. A robust affine map through all blocks is what cameras that are wrong do
to a picture (turned: a shift and a roll; a wrong focal length: a scale); single blocks are less sure than it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.signal import fftconvolve

BLOCKS = 8  # along the longer side: a block holds enough texture, and an affine map has many of them
SEARCH = 0.08  # of the longer side, to either side: farther off is the wrong place for certain
LEAST_BLOCK, LEAST_SEARCH = 9, 3  # pixels, of very small pictures
TEXTURE = 0.02  # standard deviation of brightness without its slow changes: noise of a usual clip is below
CORNER = 0.1  # of the stronger gradient's energy, across it: along an edge alone nothing can be told
LEAST_PEAK = 0.5  # correlation of a block that was found: a quarter of its variance is explained
LEAST_FOUND = 8  # blocks, for an affine map's six numbers
# times as many blocks with texture: were it the same place, more than a third of them would be found
MANY = 3
ROUNDS = 5  # of reweighting
HUBER = 1.345  # standard deviations (Huber, Robust Statistics, 1981)


@dataclass(frozen=True)
class Displacement:
    """How far a picture lies beside another.

    Attributes:
        length: Root mean square length of the affine map's displacement over the blocks, in widths of the picture; as
            far as was searched, where it was not found.
        std: Its standard deviation, in widths.
        found: False where there are many blocks with texture and hardly one is found again: farther than `length`, or
            nothing alike.
    """

    length: float
    std: float
    found: bool = True


def displacement(
    first: Float[np.ndarray, "height width"],
    second: Float[np.ndarray, "height width"],
    asked: Bool[np.ndarray, "height width"] | None = None,
) -> Displacement | None:
    """Where the first picture's blocks are in the second; None where it has too little texture to tell.

    Args:
        first: The real picture, grey, in [0, 1]: which blocks have texture is asked of it.
        second: The other one.
        asked: Only blocks that lie in there for the most part are looked for; None: all.
    """
    longer, width = max(first.shape), first.shape[1]
    side, reach = _side(first), max(LEAST_SEARCH, round(SEARCH * longer))
    at, found = [], []
    blocks = textured_blocks(first, asked)
    for x, y in blocks:
        top, left = max(0, y - reach), max(0, x - reach)
        area = second[top : y + side + reach, left : x + side + reach]
        moved = _peak(first[y : y + side, x : x + side], area)
        if moved is not None:
            at.append((x + side / 2, y + side / 2))
            found.append((moved[0] - (x - left), moved[1] - (y - top)))
    if len(found) < LEAST_FOUND:
        return Displacement(reach / width, 0.0, found=False) if len(blocks) >= MANY * LEAST_FOUND else None
    length, std = _affine(np.array(at) / longer - 0.5, np.array(found))
    return Displacement(length / width, std / width)


def textured_blocks(
    picture: Float[np.ndarray, "height width"], asked: Bool[np.ndarray, "height width"] | None
) -> list[tuple[int, int]]:
    """First pixels (x, y) of a grey picture's blocks with texture, of those that lie in `asked` for the most part."""
    height, width = picture.shape
    side = _side(picture)
    fine = picture - gaussian_filter(picture, side / 2)
    out = []
    for y in range(0, height - side + 1, side // 2):
        for x in range(0, width - side + 1, side // 2):
            block = slice(y, y + side), slice(x, x + side)
            if (asked is None or asked[block].mean() > 0.5) and _textured(fine[block]):
                out.append((x, y))
    return out


def _side(picture: Float[np.ndarray, "height width"]) -> int:
    """Side of a block, pixels."""
    return max(LEAST_BLOCK, max(picture.shape) // BLOCKS)


def _textured(block: np.ndarray) -> bool:
    """Whether a block without its slow changes shows more than noise, in both directions."""
    if block.std() < TEXTURE:
        return False
    dy, dx = np.gradient(block)
    energy = np.array([[(dx * dx).sum(), (dx * dy).sum()], [(dx * dy).sum(), (dy * dy).sum()]])
    weak, strong = np.linalg.eigvalsh(energy)
    return bool(weak > CORNER * strong)


def _peak(block: np.ndarray, area: np.ndarray) -> tuple[float, float] | None:
    """Where in the area the block's first pixel is (x, y); None where nothing is like it, or only at the rim."""
    pattern = block - block.mean()
    above = fftconvolve(area - area.mean(), pattern[::-1, ::-1], mode="valid")
    side = len(block)
    centre = tuple(slice(side // 2, side // 2 + n) for n in above.shape)
    mean = uniform_filter(area, side)[centre]
    variance = np.maximum(uniform_filter(area**2, side)[centre] - mean**2, 0.0) * block.size
    score = above / np.maximum(np.sqrt(variance * (pattern**2).sum()), 1e-9)
    y, x = np.unravel_index(score.argmax(), score.shape)
    if score[y, x] < LEAST_PEAK or not (0 < y < score.shape[0] - 1 and 0 < x < score.shape[1] - 1):
        return None
    return x + _between(score[y, x - 1 : x + 2]), y + _between(score[y - 1 : y + 2, x])


def _between(values: np.ndarray) -> float:
    """Where a parabola through three values is highest, from the middle one."""
    before, here, after = values
    bend = before - 2 * here + after
    return float(0.5 * (before - after) / bend) if bend < 0 else 0.0


def _affine(at: Float[np.ndarray, "n 2"], moved: Float[np.ndarray, "n 2"]) -> tuple[float, float]:
    """Root mean square length of the affine map through displacements, and its standard deviation."""
    through = np.zeros_like(moved)
    left = np.linalg.norm(moved, axis=1)
    basis, weight = np.column_stack([np.ones(len(at)), at]), np.ones(len(at))
    for _ in range(ROUNDS):
        scaled = np.sqrt(weight)[:, None]
        through = basis @ np.linalg.lstsq(scaled * basis, scaled * moved, rcond=None)[0]
        left = np.linalg.norm(moved - through, axis=1)
        weight = np.minimum(1.0, HUBER * _noise(left) / np.maximum(left, 1e-9))
    std = _noise(left) * np.sqrt(basis.shape[1] / len(at))
    return float(np.sqrt((through**2).sum(1).mean())), float(std)


def _noise(left: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of residuals, hardly disturbed by outliers."""
    return max(1.4826 * float(np.median(left)), 1e-6)
