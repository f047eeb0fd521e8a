"""The 4D motion: displacements on voxel grids at key times (DeVRF 3.1, "4D Voxel Deformation Field").

The backward field takes a point x seen at time t to where it rests, x + backward(x, t); the forward field takes
a resting point to where it is at t. Key times are uniform; between them fields are blended, so any ray may have
its own time. At the time of rest both fields are exactly zero and stay so.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.fields.grids import grid_shape, upsample
from devrf.reconstruct.kernels.quad import quad

MOST_ON_GPU = 1 << 30  # bytes of both fields: larger ones are kept in main memory


def store_for(keys: int, shape: tuple[int, int, int], device: torch.device | str) -> torch.device:
    """Where fields of a size are kept: on the device they are trained on, unless they are too large for a GPU."""
    size = 2 * 3 * 4 * keys * shape[0] * shape[1] * shape[2]
    return torch.device("cpu") if size > MOST_ON_GPU else torch.device(device)


@dataclass
class MotionField:
    """Backward and forward motion.

    Attributes:
        aabb: Box of the fields [2, 3], on the CPU.
        backward, forward: Displacements at key times and vertices; all key times of a fine field may be too much
            for a GPU's memory and lie on the CPU, then a `window` of them is looked at.
        t_first, t_last: First and last key time, in the scene's time of [0, 1].
        rest_key: Key time at which both are zero (of movers: the nearest to rest); None where the moving cameras never
            see the scene at rest.
    """

    aabb: Float[Tensor, "2 3"]
    backward: Float[Tensor, "T X Y Z 3"]
    forward: Float[Tensor, "T X Y Z 3"]
    t_first: float
    t_last: float
    rest_key: int | None

    @staticmethod
    def still(
        aabb: Float[Tensor, "2 3"],
        keys: int,
        resolution: float | int,
        ends: tuple[float, float],
        rest_key: int | None,
        device: str,
    ) -> "MotionField":
        """Fields in which nothing moves, from their first to their last key time."""
        shape = grid_shape(aabb, resolution)
        zero = torch.zeros(keys, *shape, 3, device=store_for(keys, shape, device))
        return MotionField(aabb, zero, zero.clone(), *ends, rest_key)

    @property
    def keys(self) -> int:
        """Number of key times."""
        return len(self.backward)

    @property
    def key_times(self) -> list[float]:
        """When they are, in the scene's time of [0, 1]."""
        return np.linspace(self.t_first, self.t_last, self.keys).tolist()

    def numbers(self) -> dict[str, float | int | None]:
        """What files say of it besides its fields and its box."""
        return {"t_first": self.t_first, "t_last": self.t_last, "rest_key": self.rest_key}

    def tau(self, time: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Times in units of the key times' spacing, held to the first and last."""
        span = max(self.t_last - self.t_first, 1e-9)
        return ((time - self.t_first) / span).clamp(0, 1) * (self.keys - 1)

    def window(self, first: int, last: int, device: torch.device | str) -> "MotionField":
        """Key times `first` to `last` (at least two) on a device; where they are there already, the same memory."""
        if not 0 <= first < last < self.keys:
            raise ValueError(f"keys {first} to {last} of {self.keys}: expected two or more of them")
        spacing = (self.t_last - self.t_first) / (self.keys - 1)
        rest_key = self.rest_key
        return MotionField(
            self.aabb,
            self.backward[first : last + 1].to(device),
            self.forward[first : last + 1].to(device),
            self.t_first + first * spacing,
            self.t_first + last * spacing,
            rest_key - first if rest_key is not None and first <= rest_key <= last else None,
        )

    def at(self, time: float, device: torch.device | str) -> tuple["MotionField", Float[Tensor, "1"]]:
        """The two key times around a time, on a device, and the time in units of their spacing."""
        tau = self.tau(torch.tensor([time], dtype=torch.float32))
        first = min(int(tau), self.keys - 2)
        return self.window(first, first + 1, device), (tau - first).to(device)

    def to_rest(self, x: Float[Tensor, "S 3"], tau: Float[Tensor, " S"]) -> Float[Tensor, "S 3"]:
        """Where points seen at their times rest."""
        return x + quad(self.backward, x, tau, self.aabb)

    def from_rest(self, x_rest: Float[Tensor, "S 3"], tau: Float[Tensor, " S"]) -> Float[Tensor, "S 3"]:
        """Where resting points are at given times."""
        return x_rest + quad(self.forward, x_rest, tau, self.aabb)

    def stored(self, device: torch.device | str) -> "MotionField":
        """The same fields where fields of their size are kept, for work on `device`."""
        x, y, z = self.backward.shape[1:4]
        where = store_for(self.keys, (x, y, z), device)
        return replace(self, backward=self.backward.to(where), forward=self.forward.to(where))

    def refined(self, resolution: float | int, device: torch.device | str) -> "MotionField":
        """The same motion on more vertices; computed on `device`, kept there where it fits."""
        shape = grid_shape(self.aabb, resolution)

        def finer(field: Tensor) -> Tensor:
            out = torch.empty(self.keys, *shape, 3, device=where)
            for key, grid in enumerate(field):
                out[key] = upsample(grid.to(device), shape)
            return out

        where = store_for(self.keys, shape, device)
        return replace(self, backward=finer(self.backward), forward=finer(self.forward))
