"""Explicit factors of space and time: HexPlane (Cao and Johnson, CVPR 2023), K-Planes (Fridovich-Keil et al., 2023).

A place at a time is projected onto six planes, three of space and three of space and time. HexPlane multiplies the
features of planes that complement each other and joins the three products; K-Planes multiplies all six, at several
resolutions, and joins these. A small network turns features into density and colour. Losses of K-Planes (Section
3.3): total variation in space, no jerks in time, and little that depends on time.
"""

from collections.abc import Sequence
from itertools import combinations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from devrf.lab.methods.field import (
    FieldMethod,
    FieldPoints,
    FieldTraining,
    RadianceField,
    RenderedRays,
    Sampled,
    Settings,
    dense,
)
from devrf.lab.methods.method_table import Size
from devrf.lab.methods.networks import Encoding
from devrf.lab.methods.pictures import TaskPictures
from devrf.lab.methods.protocol import MethodTask
from devrf.reconstruct.rendering.rays import RayBatch

SETTINGS: dict[Size, Settings] = {
    "small": Settings(rays=512, samples=(32, 32), rate=2e-2, last_rate=1e-3),
    "full": Settings(rays=4096, samples=(64, 64), rate=1e-2, last_rate=1e-4),
}
GRIDS: dict[str, tuple[tuple[int, ...], int]] = {
    "small": ((16, 32, 64), 12),
    "full": ((64, 128, 256, 512), 32),
}
HIDDEN = 64
NETWORK_SHARE = 0.05  # of the rate (HexPlane: 0.02 and 0.001)
PAIRS = tuple(combinations(range(4), 2))  # of x, y, z, t; those with t are 2, 4 and 5
IN_TIME = tuple(n for n, pair in enumerate(PAIRS) if 3 in pair)
OPPOSITE = ((0, 5), (1, 4), (3, 2))  # planes that complement each other: xy and zt, xz and yt, yz and xt
VARIATION, JERKS, CHANGES = 2e-4, 1e-3, 1e-4


class Planes(RadianceField):
    """Six planes at each resolution."""

    def __init__(self, size: Size, moments: Float[Tensor, " t"], rest_time: float, hex_plane: bool) -> None:
        super().__init__()
        self.hex_plane, self.rest_time = hex_plane, rest_time
        sides, channels = GRIDS[size]
        if hex_plane:
            sides, channels = sides[-1:], channels * len(sides)
        keys = max(2, len(moments))
        self.planes = nn.ParameterList()
        for side in sides:
            for n, (_, second) in enumerate(PAIRS):
                plane = torch.empty(1, channels, keys if second == 3 else side, side)
                self.planes.append(nn.Parameter(plane.fill_(1) if n in IN_TIME else plane.uniform_(0.1, 0.5)))
        joined = channels * (len(OPPOSITE) if hex_plane else len(sides))
        self.direction = Encoding(3, 4)
        self.density = nn.Sequential(nn.Linear(joined, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 16))
        self.colour = nn.Sequential(
            nn.Linear(15 + self.direction.size, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, HIDDEN),
            nn.ReLU(),
            nn.Linear(HIDDEN, 3),
            nn.Sigmoid(),
        )

    def forward(self, points: FieldPoints) -> Sampled:
        """Density and colour at a time; at rest, at the time of rest."""
        time = torch.where(points.rest > 0, self.rest_time, points.time)
        place = torch.cat([points.x, 2 * time[:, None] - 1], 1)
        found = [self._level(planes, place) for planes in self.levels()]
        h = self.density(torch.cat(found, 1))
        rgb = self.colour(torch.cat([h[:, 1:], self.direction(points.d)], 1))
        return Sampled(dense(h[:, 0]), rgb, {})

    def levels(self) -> list[list[nn.Parameter]]:
        """The six planes of each resolution."""
        every = list(self.planes)
        return [every[n : n + len(PAIRS)] for n in range(0, len(every), len(PAIRS))]

    def _level(self, planes: Sequence[nn.Parameter], place: Float[Tensor, "n 4"]) -> Float[Tensor, "n c"]:
        each = [sampled(plane, place[:, list(pair)]) for plane, pair in zip(planes, PAIRS, strict=True)]
        if self.hex_plane:
            return torch.cat([each[a] * each[b] for a, b in OPPOSITE], 1)
        return torch.stack(each).prod(0)

    def losses(self, field: FieldTraining, rays: RayBatch, seen: RenderedRays) -> dict[str, Tensor]:
        """Even in space, without jerks in time, mostly at rest."""
        return self.regularised()

    def regularised(self) -> dict[str, Tensor]:
        """The losses, which depend on the planes alone."""
        variation, jerks, changes = [], [], []
        for planes in self.levels():
            for n, plane in enumerate(planes):
                variation.append(plane.diff(dim=3).square().mean())
                if n in IN_TIME:
                    jerks.append(
                        plane.diff(dim=2).diff(dim=2).square().mean()
                        if plane.shape[2] > 2
                        else plane.new_zeros(())
                    )
                    changes.append((1 - plane).abs().mean())
                else:
                    variation.append(plane.diff(dim=2).square().mean())
        return {
            "variation": VARIATION * torch.stack(variation).sum(),
            "jerks": JERKS * torch.stack(jerks).sum(),
            "changes": CHANGES * torch.stack(changes).sum(),
        }

    def rates(self) -> list[tuple[float, list[nn.Parameter]]]:
        """HexPlane's networks learn at a twentieth of its planes' rate."""
        networks = [*self.density.parameters(), *self.colour.parameters()]
        return [(1.0, list(self.planes)), (NETWORK_SHARE if self.hex_plane else 1.0, networks)]

    def still(self) -> list[nn.Parameter]:
        """Planes of space and the networks."""
        planes = [p for of in self.levels() for n, p in enumerate(of) if n not in IN_TIME]
        return [*planes, *self.density.parameters(), *self.colour.parameters()]


def sampled(plane: Float[Tensor, "1 c h w"], at: Float[Tensor, "n 2"]) -> Float[Tensor, "n c"]:
    """Features of a plane at places in [-1, 1], bilinear."""
    found = nn.functional.grid_sample(plane, at[None, None], align_corners=True, padding_mode="border")
    return found[0, :, 0].T


def method(hex_plane: bool) -> FieldMethod:
    """One of both."""

    def make(task: MethodTask, pictures: TaskPictures) -> Planes:
        return Planes(task.size, pictures.moments, pictures.rest_time, hex_plane)

    return FieldMethod(make, SETTINGS)


HEX_PLANE, K_PLANES = method(True), method(False)
