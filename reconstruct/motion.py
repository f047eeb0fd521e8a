"""The 4D motion: displacements on voxel grids at key times (DeVRF 3.1, "4D Voxel Deformation Field").

The backward field takes a point x seen at time t to where it rests, x + backward(x, t); the forward field takes
a resting point to where it is at t. Key times are uniform; between them fields are blended, so any ray may have
its own time. At the key time of rest both fields are exactly zero and stay so.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.grids import grid_shape, upsample
from devrf.reconstruct.kernels.quad import quad


@dataclass
class MotionField:
    """Backward and forward motion.

    Attributes:
        aabb: Box of the fields [2, 3], on the CPU.
        backward, forward: Displacements at key times and vertices.
        t_first, t_last: First and last key time, in the scene's time of [0, 1].
        rest_key: Key time at which both are zero; None where the moving cameras never see the scene at rest.
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
        *,
        t_first: float,
        t_last: float,
        rest_key: int | None,
        device: str,
    ) -> "MotionField":
        """Fields in which nothing moves."""
        zero = torch.zeros(keys, *grid_shape(aabb, resolution), 3, device=device)
        return MotionField(aabb, zero, zero.clone(), t_first, t_last, rest_key)

    @property
    def keys(self) -> int:
        """Number of key times."""
        return len(self.backward)

    def tau(self, time: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
        """Times in units of the key times' spacing, held to the first and last."""
        span = max(self.t_last - self.t_first, 1e-9)
        return ((time - self.t_first) / span).clamp(0, 1) * (self.keys - 1)

    def to_rest(self, x: Float[Tensor, "S 3"], tau: Float[Tensor, " S"]) -> Float[Tensor, "S 3"]:
        """Where points seen at their times rest."""
        return x + quad(self.backward, x, tau, self.aabb)

    def from_rest(self, x_rest: Float[Tensor, "S 3"], tau: Float[Tensor, " S"]) -> Float[Tensor, "S 3"]:
        """Where resting points are at given times."""
        return x_rest + quad(self.forward, x_rest, tau, self.aabb)

    def refined(self, resolution: float | int) -> "MotionField":
        """The same motion on more vertices."""
        shape = grid_shape(self.aabb, resolution)
        return replace(
            self,
            backward=torch.stack([upsample(grid, shape) for grid in self.backward]),
            forward=torch.stack([upsample(grid, shape) for grid in self.forward]),
        )
