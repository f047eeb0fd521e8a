"""HyperNeRF (Park et al., SIGGRAPH Asia 2021): Nerfies whose template is cut by a bent surface in more dimensions.

Published: two ambient dimensions, a slicing network of 6 layers of 64 with its own frequencies, the template sees the
ambient place with one frequency, whose window opens later (Section 4.3); otherwise Nerfies.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from devrf.lab.methods.field import FieldMethod, FieldPoints
from devrf.lab.methods.method_table import Size
from devrf.lab.methods.nerfies import CODE, SETTINGS, Nerfies
from devrf.lab.methods.networks import Encoding, Mlp

AMBIENT = 2
SLICE = {"small": (4, 32), "full": (6, 64)}  # depth and width
SLICE_FREQUENCIES: dict[Size, int] = {"small": 4, "full": 7}
WINDOW = 0.1  # of the budget until the frequency of the ambient place counts


class HyperNerf(Nerfies):
    """A template in five dimensions, rigid motions, and a bent slice."""

    def __init__(self, size: Size, moments: Float[Tensor, " t"]) -> None:
        ambient, (depth, width) = Encoding(AMBIENT, 1), SLICE[size]
        super().__init__(size, moments, ambient.size)
        self.slice_place, self.ambient = Encoding(3, SLICE_FREQUENCIES[size]), ambient
        self.slice = Mlp(self.slice_place.size + CODE, AMBIENT, depth, width, small=1e-5)

    def beside(self, points: FieldPoints, code: Float[Tensor, "n c"]) -> list[Tensor]:
        """Where the slice is at each place (their Eq. 5); at rest it is flat."""
        w = self.slice(torch.cat([self.slice_place(points.x), code], 1))
        return [self.ambient(w * (1 - points.rest[:, None]))]

    def bent(self) -> list[nn.Parameter]:
        """The slice."""
        return list(self.slice.parameters())

    def advance(self, share: float) -> None:
        """Open both windows."""
        super().advance(share)
        self.ambient.alpha = min(1.0, share / WINDOW)


METHOD = FieldMethod(lambda task, pictures: HyperNerf(task.size, pictures.moments), SETTINGS)
