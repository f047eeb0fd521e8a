"""D-NeRF (Pumarola et al., CVPR 2021): a network moves points to a canonical NeRF.

Published: both networks of 8 layers of 256, ten frequencies of places, four of directions and times (Section 4), 64
samples evenly and 128 more, 500 rays a step. What is at rest is not moved (their Eq. 3, with t = 0 at rest).
"""

import torch
from torch import nn

from devrf.lab.methods.field import FieldMethod, FieldPoints, RadianceField, Sampled, Settings, dense
from devrf.lab.methods.method_table import Size
from devrf.lab.methods.networks import FREQUENCIES, Encoding, Mlp, RadianceMlp

SETTINGS: dict[Size, Settings] = {
    "small": Settings(rays=256, samples=(24, 24), rate=5e-3, last_rate=5e-4),
    "full": Settings(rays=500, samples=(64, 128), rate=5e-4, last_rate=5e-5),
}
NETWORKS = {"small": (4, 96), "full": (8, 256)}  # depth and width
WARP_SHARE: dict[Size, float] = {"small": 0.2, "full": 1.0}  # of the rate


class DNerf(RadianceField):
    """A canonical radiance field and displacements to it."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        depth, width = NETWORKS[size]
        self.warp_share = WARP_SHARE[size]
        self.place, self.direction, self.time = Encoding(3, FREQUENCIES[size]), Encoding(3, 4), Encoding(1, 4)
        self.warp = Mlp(self.place.size + self.time.size, 3, depth, width, small=1e-4)
        self.canonical = RadianceMlp(self.place.size, depth, width, self.direction.size)

    def forward(self, points: FieldPoints) -> Sampled:
        """Density and colour where points come from."""
        encoded = torch.cat([self.place(points.x), self.time(2 * points.time[:, None] - 1)], 1)
        x = points.x + self.warp(encoded) * (1 - points.rest[:, None])
        density, rgb, _ = self.canonical(self.place(x), self.direction(points.d))
        return Sampled(dense(density), rgb, {})

    def rates(self) -> list[tuple[float, list[nn.Parameter]]]:
        """The motion more slowly where rates are large: else it folds before there is something to move."""
        return [(1.0, list(self.canonical.parameters())), (self.warp_share, list(self.warp.parameters()))]

    def still(self) -> list[nn.Parameter]:
        """The canonical field."""
        return list(self.canonical.parameters())


METHOD = FieldMethod(lambda task, pictures: DNerf(task.size), SETTINGS)
