"""Voxel grids: how many vertices a box gets, how a grid is refined, how its few touched values are trained.

Grids are channel last, [X, Y, Z, C]; the first and last vertex of an axis lie on the box.
"""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.reconstruct.kernels.adam import masked_step

BETAS = (0.9, 0.99)  # DirectVoxGO's; the papers say "Adam"
EPS = 1e-8
TOUCHED = 1e-30  # in place of a second moment: next to none, but not none
# share of the vertices below which a checkpoint holds them one by one, else the whole grid: no copy
FEW = 0.25


def grid_shape(
    aabb: Float[Tensor, "2 3"], resolution: float | int, planes: int | None = None
) -> tuple[int, int, int]:
    """Vertices along each axis of a grid of about resolution^3 vertices, in proportion to the box, at least 2.

    Args:
        aabb: The box.
        resolution: Cube root of the number of vertices.
        planes: Vertices along z, where they are given (multi-plane grids).
    """
    extent = (aabb[1] - aabb[0]).double()
    if planes is not None:
        voxel = float((extent[0] * extent[1] * planes / resolution**3) ** 0.5)
        x, y = (max(2, round(float(e) / voxel)) for e in extent[:2])
        return x, y, planes
    voxel = float(extent.prod() ** (1 / 3)) / resolution
    x, y, z = (max(2, round(float(e) / voxel)) for e in extent)
    return x, y, z


def voxel_size(aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int]) -> float:
    """Edge of a cube of a voxel's volume."""
    cells = [(float(b) - float(a)) / (n - 1) for a, b, n in zip(*aabb.tolist(), shape, strict=True)]
    return (cells[0] * cells[1] * cells[2]) ** (1 / 3)


def vertices(aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int]) -> Float[Tensor, "X Y Z 3"]:
    """Positions of a grid's vertices."""
    axes = [torch.linspace(a, b, n) for a, b, n in zip(*aabb.tolist(), shape, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)


def upsample(grid: Float[Tensor, "X Y Z C"], shape: tuple[int, int, int]) -> Float[Tensor, "A B D C"]:
    """The same function on another number of vertices (trilinear; corners stay corners)."""
    volume = grid.permute(3, 0, 1, 2)[None]
    out = F.interpolate(volume, size=shape, mode="trilinear", align_corners=True)
    return torch.empty(*shape, grid.shape[3], device=grid.device).copy_(out[0].permute(1, 2, 3, 0))


def grown(occupied: Bool[Tensor, "X Y Z"]) -> Bool[Tensor, "X Y Z"]:
    """A set of vertices and all their neighbours."""
    volume = occupied.float()[None, None]
    for kernel, padding in (((3, 1, 1), (1, 0, 0)), ((1, 3, 1), (0, 1, 0)), ((1, 1, 3), (0, 0, 1))):
        volume = F.max_pool3d(volume, kernel, stride=1, padding=padding)
    return volume[0, 0] > 0


@dataclass
class GridTrainer:
    """Adam on the vertices of one grid that rays can touch, with moments and a gradient that stay in place.

    Attributes:
        values: The grid; changed in place.
        copies: Buffers for the gradient, for as many threads.
        reachable: Vertices that a step visits, as numbers of the flattened grid; none before `visit`.
        grad: Where the backward passes add.
        step: Steps so far.
    """

    values: Float[Tensor, "X Y Z C"]
    copies: int = 1
    reachable: Int[Tensor, " A"] = field(init=False)
    grad: Float[Tensor, "P X Y Z C"] = field(init=False)
    moment1: Float[Tensor, "X Y Z C"] = field(init=False)
    moment2: Float[Tensor, "X Y Z C"] = field(init=False)
    step: int = 0

    def __post_init__(self) -> None:
        self.reachable = torch.zeros(0, dtype=torch.int64, device=self.values.device)
        self.grad = self.values.new_zeros(self.copies, *self.values.shape)
        self.moment1, self.moment2 = (torch.zeros_like(self.values) for _ in range(2))

    def visit(self, reachable: Bool[Tensor, "X Y Z"]) -> None:
        """Say which vertices steps visit from now on."""
        self.reachable = reachable.reshape(-1).nonzero()[:, 0]

    def update(self, lr: float, flag: Float[Tensor, "X Y Z 1"] | None = None) -> None:
        """One step with the gradient that has gathered, which is cleared; vertices of flag 0 have none."""
        self.step += 1
        channels = self.values.shape[3]
        values, moment1, moment2 = (x.view(-1, channels) for x in (self.values, self.moment1, self.moment2))
        grad, flags = self.grad.view(self.copies, -1, channels), None if flag is None else flag.view(-1)
        masked_step(values, grad, moment1, moment2, self.reachable, self.step, lr, BETAS, EPS, flags)

    def forget(self) -> None:
        """Fresh moments; what has been touched stays so."""
        self.step = 0
        self.grad.zero_()
        self.moment1.zero_()
        self.moment2 = torch.where(self.moment2 == 0, 0.0, TOUCHED)

    def touched(self) -> Bool[Tensor, "X Y Z"]:
        """Vertices that have ever had a gradient."""
        return (self.moment2 > 0).any(-1)

    def state(self) -> dict[str, Tensor]:
        """What later steps depend on beside values and reach: few vertices have moments, hardly any a gradient left.

        A gradient is left where `update` was told that a vertex has none; it counts once the vertex is visited again.
        Where there are many, the whole grid is handed on: it need not be copied.
        """
        out = {"step": torch.tensor(self.step)}
        for name in ("moment1", "moment2", "grad"):
            rows = getattr(self, name).view(-1, self.values.shape[3])
            at = (rows != 0).any(1).nonzero()[:, 0]
            few = len(at) < FEW * len(rows)
            out |= {f"{name}_at": at, name: rows[at]} if few else {name: rows}
        return out

    def take_up(self, state: dict[str, Tensor]) -> None:
        """Go on from a `state`; `visit` has to follow."""
        self.step = int(state["step"])
        for name in ("moment1", "moment2", "grad"):
            rows = getattr(self, name).view(-1, self.values.shape[3])
            if f"{name}_at" not in state:
                rows.copy_(state[name])
                continue
            rows.zero_()
            rows[state[f"{name}_at"].to(rows.device)] = state[name].to(rows.device)
