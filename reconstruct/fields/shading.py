"""How brightness changes in space and time: cast shadows, faces that turn away from a light.

A coarse, smooth grid of the logarithm of a factor, one for what stands and one for what moves (at rest).
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.kernels.composite_layers import ShadingGrid

LONGEST, LEAST = 33, 4  # cells along the longest side; along the shortest
KEYS = 14  # moments, of motion that is no longer than the numbers of training are meant for
EVEN, SMALL = 2.0, 0.1  # weights of squared differences of neighbours and of squared values


class Shading(torch.nn.Module):
    """The grid.

    Attributes:
        aabb: Its box, on the CPU.
        t_first, t_last: Times of its first and last moment, in [0, 1].
        grid: Logarithms of the factor [2, T, X, Y, Z].
    """

    _corners: Tensor
    _last: Tensor
    _box: Tensor

    def __init__(
        self, aabb: Float[Tensor, "2 3"], t_first: float, t_last: float, grid: Float[Tensor, "2 T X Y Z"]
    ) -> None:
        super().__init__()
        self.aabb, self.t_first, self.t_last = aabb, t_first, t_last
        self.grid = torch.nn.Parameter(grid)
        ends = torch.cartesian_prod(*[torch.arange(2)] * 4) * torch.tensor(grid.stride()[1:])
        # On the grid's device once: constants that are sent to a GPU in each iteration are what it waits for.
        self.register_buffer("_corners", ends.sum(1).to(grid.device), persistent=False)
        self.register_buffer("_last", torch.tensor(grid.shape[1:]).to(grid.device) - 1, persistent=False)
        self.register_buffer("_box", aabb.to(grid.device), persistent=False)

    @staticmethod
    def none(
        aabb: Float[Tensor, "2 3"], t_first: float, t_last: float, device: torch.device, longer: float = 1.0
    ) -> "Shading":
        """A factor of one everywhere; for motion that is so many times `longer` than KEYS are meant for."""
        sides = (aabb[1] - aabb[0]).tolist()
        shape = [max(LEAST, round(LONGEST * side / max(sides))) for side in sides]
        keys = 1 + round(longer * (KEYS - 1))
        return Shading(aabb, t_first, t_last, torch.zeros(2, keys, *shape, device=device))

    def at(
        self, layer: Int[Tensor, " S"], x: Float[Tensor, "S 3"], time: Float[Tensor, " S"]
    ) -> Float[Tensor, " S"]:
        """Logarithms of the factor at points of a layer (0 stands, 1 moves), linear in place and time."""
        lo, hi = self._box.to(x)
        unit = torch.cat([self._share(time)[:, None], (x - lo) / (hi - lo)], dim=1)
        at = unit.clamp(0, 1) * self._last
        first = torch.minimum(at.floor().long(), self._last - 1)
        ends = torch.stack([1 - (at - first), at - first], dim=1)
        weights = torch.einsum("na,nb,nc,nd->nabcd", *ends.unbind(2)).reshape(len(x), 16)
        layers, *strides = self.grid.stride()
        base = layer * layers + sum(first[:, axis] * stride for axis, stride in enumerate(strides))
        # gather's gradient adds up in the same order each time; that of an index does not.
        corners = self.grid.reshape(-1).gather(0, (base[:, None] + self._corners).reshape(-1))
        return (weights * corners.reshape(-1, 16)).sum(1)

    def light(self, times: Float[Tensor, " F"]) -> ShadingGrid:
        """The same for whole pictures."""
        return ShadingGrid(self.grid, self.aabb, self._share(times).clamp(0, 1) * (self.grid.shape[1] - 1))

    def _share(self, time: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """How much of its span is behind."""
        return (time - self.t_first) / max(self.t_last - self.t_first, 1e-9)

    def penalty(self) -> Float[Tensor, ""]:
        """What keeps it smooth and near to no change."""
        differences = sum((self.grid.diff(dim=axis) ** 2).mean() for axis in range(1, 5))
        return EVEN * differences + SMALL * (self.grid**2).mean()
