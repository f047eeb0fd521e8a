"""Which space is empty and where surfaces are, by the points that structure from motion has found.

A point that a picture shows proves that the line of sight to it is free and that something is at its end (space
carving by sparse points). A first model that starts from this need not find the scene's shape in fog.
"""

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.kernels.background import Contraction, contract

LEAST_LINES = 2  # of sight through a vertex' cell, before it counts as free: one may be a wrong match
# ends in a vertex' neighbourhood over lines through it, up to which it is free all the same
ENDS_SHARE = 0.05
SHORT_OF = 1.5  # voxels that a line is cut before its point: the point's own depth is not exact
STRIDE = 0.8  # voxels from one look at a line to the next
BLOCK = 1 << 17  # lines followed at once


def trained_lines(scene: Scene) -> tuple[Float[Tensor, "M 3"], Float[Tensor, "M 3"]] | None:
    """Lines of sight of the training pictures: camera centres and points; None without points.

    Args:
        scene: In the box frame.
    """
    if scene.points is None:
        return None
    trained = np.array([frame.split == "train" for frame in scene.static], dtype=bool)
    seen = trained[scene.points.obs_frame]
    if not seen.any():
        return None
    start, end = scene.points.lines_of_sight(scene.static)
    return torch.from_numpy(start[seen]).float(), torch.from_numpy(end[seen]).float()


def carve(
    start: Float[Tensor, "M 3"],
    end: Float[Tensor, "M 3"],
    aabb: Float[Tensor, "2 3"],
    size: int,
    near: float,
    contraction: Contraction,
) -> tuple[Bool[Tensor, "N N N"], Bool[Tensor, "N N N"]]:
    """Vertices of the contracted cube (kernels/background.py) that are free, and those at a surface.

    Args:
        start: Camera centres.
        end: The point seen from each.
        aabb: The box in the middle.
        size: Vertices of the cube along each axis.
        near: Distance from the centres at which lines begin.
        contraction: Of space to the cube.
    """
    passed, ended = (torch.zeros(size**3) for _ in range(2))
    middle, half = (aabb[0] + aabb[1]) / 2, (aabb[1] - aabb[0]) / 2
    voxel = 4 / (size - 1)

    def vertex(x: Tensor) -> Tensor:
        at = ((contract((x - middle) / half, contraction) + 2) / voxel + 0.5).long().clamp(0, size - 1)
        return (at[:, 0] * size + at[:, 1]) * size + at[:, 2]

    for a, b in zip(start.split(BLOCK), end.split(BLOCK), strict=True):
        length = (b - a).norm(dim=1)
        direction = (b - a) / length[:, None].clamp(min=1e-9)
        ended.index_add_(0, vertex(b), torch.ones(len(b)))
        going, t = torch.arange(len(a)), torch.full_like(length, near)
        counted = torch.full((len(a),), -1)  # where each line was last: it counts once in every cell
        while len(going):
            x = a[going] + t[going, None] * direction[going]
            # A voxel's length there: the contraction shrinks space with the distance from the middle.
            local = voxel * float(half.min()) * ((x - middle) / half).abs().amax(1).clamp(min=1)
            on = t[going] + SHORT_OF * local < length[going]
            going, at = going[on], vertex(x[on])
            passed.index_add_(0, at, (at != counted[going]).float())
            counted[going] = at
            t[going] += STRIDE * local[on]
    passed, ended = passed.reshape(size, size, size), ended.reshape(size, size, size)
    ends = 27 * F.avg_pool3d(ended[None, None], 3, 1, 1)[0, 0]
    free = (passed >= LEAST_LINES) & (ends <= ENDS_SHARE * passed)
    return free, (ends > 0.5) & ~free
