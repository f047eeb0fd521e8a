"""Normalised device coordinates, for scenes that all cameras look at from one side (Mildenhall et al. 2020, App. C).

The frustum of a reference camera at the origin of the box frame, which looks along +z, becomes the cube [-1, 1]^3:

    x' = x / (z tan_x),  y' = y / (z tan_y),  z' = 1 - 2 NEAR / z        (OpenCV axes)

z' is -1 on the near plane and 1 at infinity, so far things get few voxels. Straight lines stay straight.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

NEAR = 1.0  # distance of the near plane; the box frame is scaled so that everything lies behind it
FARTHEST = 1 - 1e-3  # z' up to which points are taken back into the world (published value)
CUBE = torch.tensor([[-1.0] * 3, [1.0] * 3])
SIDEWAYS = 1e-4  # cosine to the reference axis below which a ray never meets the near plane


@dataclass(frozen=True)
class Ndc:
    """The reference camera's frustum.

    Attributes:
        tan_x, tan_y: Tangents of its half angles.
    """

    tan_x: float
    tan_y: float

    def from_world(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Points in front of the reference camera, in normalised device coordinates."""
        z = x[:, 2]
        return torch.stack([x[:, 0] / (z * self.tan_x), x[:, 1] / (z * self.tan_y), 1 - 2 * NEAR / z], dim=-1)

    def to_world(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """The inverse; points beyond `FARTHEST` are brought back to it."""
        z = 2 * NEAR / (1 - x[:, 2].clamp(max=FARTHEST))
        return torch.stack([x[:, 0] * z * self.tan_x, x[:, 1] * z * self.tan_y, z], dim=-1)

    def rays(
        self, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"]
    ) -> tuple[Float[Tensor, "R 3"], Float[Tensor, "R 3"]]:
        """The same rays in normalised device coordinates, from the near plane on.

        Directions have a third component of 1, so t is z' + 1, from 0 (near plane) to 2 (infinity). Rays that
        look away from the scene start behind it and miss the cube.
        """
        dz = rays_d[:, 2:]
        ahead = dz > SIDEWAYS
        safe = torch.where(ahead, dz, 1.0)
        start = self.from_world(torch.where(ahead, rays_o + (NEAR - rays_o[:, 2:]) / safe * rays_d, NEAR))
        scale = rays_d.new_tensor([self.tan_x, self.tan_y])
        end = rays_d[:, :2] / safe / scale
        d = torch.cat([(end - start[:, :2]) / 2, torch.ones_like(dz)], dim=1)
        return torch.where(ahead, start, start.new_tensor([0.0, 0.0, 2.0])), d
