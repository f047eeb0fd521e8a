"""Parts that many methods share: encodings with a window, perceptrons with a skip, codes of moments."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from devrf.lab.methods.method_table import Size


class Encoding(nn.Module):
    """Positional encoding (Mildenhall et al., NeRF, 2020, Eq. 4) with a window over its frequencies.

    The window is that of Nerfies (Park et al., 2021, Eq. 8): frequency j has the weight
    (1 - cos(pi clamp(alpha - j, 0, 1))) / 2.
    """

    def __init__(self, channels: int, frequencies: int, raw: bool = True) -> None:
        super().__init__()
        self.raw, self.frequencies = raw, frequencies
        self.size = channels * (2 * frequencies + raw)
        self.alpha = float(frequencies)

    def forward(self, x: Float[Tensor, "n c"]) -> Float[Tensor, "n e"]:
        """Encode; values in about [-1, 1]."""
        j = torch.arange(self.frequencies, device=x.device)
        angle = math.pi * x[:, None] * (2.0**j)[:, None]
        weight = window(self.alpha, self.frequencies).to(x)[:, None]
        waves = torch.cat([(weight * angle.sin()).flatten(1), (weight * angle.cos()).flatten(1)], 1)
        return torch.cat([x, waves], 1) if self.raw else waves


def window(alpha: float, frequencies: int) -> Float[Tensor, " j"]:
    """Weights of frequencies: all 0 at alpha 0, all 1 once alpha is their number."""
    j = torch.arange(frequencies)
    return (1 - torch.cos(math.pi * (alpha - j).clamp(0, 1))) / 2


FREQUENCIES: dict[Size, int] = {"small": 6, "full": 10}
"""Of places, as NeRF has them; small pictures have nothing finer than the fewer ones."""


def linear(inputs: int, outputs: int) -> nn.Linear:
    """A layer that begins as NeRF's do (Glorot and Bengio 2010); torch's own shrink what goes through them."""
    layer = nn.Linear(inputs, outputs)
    nn.init.xavier_uniform_(layer.weight)
    nn.init.zeros_(layer.bias)
    return layer


class Mlp(nn.Module):
    """A perceptron whose input is joined again in the middle, as in NeRF.

    Args:
        inputs, outputs: Channels.
        depth, width: Hidden layers.
        skip: Layer before which the input is joined again; None: nowhere.
        small: Bound of the last layer's uniform weights; None: as usual.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        depth: int,
        width: int,
        skip: int | None = 4,
        small: float | None = None,
    ) -> None:
        super().__init__()
        self.skip = skip if skip is not None and skip < depth else None
        sizes = [inputs, *[width] * (depth - 1)]
        self.hidden = nn.ModuleList(
            linear(size + (inputs if n == self.skip else 0), width) for n, size in enumerate(sizes)
        )
        self.out = linear(width, outputs)
        if small is not None:
            nn.init.uniform_(self.out.weight, -small, small)

    def features(self, x: Float[Tensor, "n i"]) -> Float[Tensor, "n w"]:
        """Before the last layer."""
        h = x
        for n, layer in enumerate(self.hidden):
            h = torch.relu(layer(torch.cat([h, x], 1) if n == self.skip else h))
        return h

    def forward(self, x: Float[Tensor, "n i"]) -> Float[Tensor, "n o"]:
        """The output, without an activation."""
        return self.out(self.features(x))


class Codes(nn.Module):
    """A learned code for each moment (generative latent optimisation), linear between moments.

    A test camera has no code of its own: what it sees at a time is what the others saw then.
    """

    moments: Tensor

    def __init__(self, moments: Float[Tensor, " t"], channels: int, spread: float = 0.05) -> None:
        super().__init__()
        self.register_buffer("moments", moments)
        self.table = nn.Parameter((2 * torch.rand(len(moments), channels) - 1) * spread)

    def forward(self, time: Float[Tensor, " n"]) -> Float[Tensor, "n c"]:
        """Codes of times."""
        if len(self.moments) == 1:
            return self.table.expand(len(time), -1)
        last = len(self.moments) - 1
        after = torch.searchsorted(self.moments, time.contiguous()).clamp(1, last)
        low, high = self.moments[after - 1], self.moments[after]
        share = ((time - low) / (high - low)).clamp(0, 1)[:, None]
        return torch.lerp(self.table[after - 1], self.table[after], share)


class RadianceMlp(nn.Module):
    """NeRF's network: density from a place, colour from place and direction (Mildenhall et al. 2020, Figure 7).

    Args:
        place: Channels of what a place is encoded as.
        depth, width: Of the trunk.
        direction: Channels of what a direction, and what else colour depends on, is encoded as.
    """

    def __init__(self, place: int, depth: int, width: int, direction: int) -> None:
        super().__init__()
        self.trunk = Mlp(place, width, depth, width)
        self.density = linear(width, 1)
        self.colour = nn.Sequential(
            linear(width + direction, width // 2), nn.ReLU(), linear(width // 2, 3), nn.Sigmoid()
        )

    def forward(
        self, place: Float[Tensor, "n p"], direction: Float[Tensor, "n q"]
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n w"]]:
        """Density before its activation, colour, and the features of the place."""
        h = self.trunk.features(place)
        return self.density(h)[:, 0], self.colour(torch.cat([self.trunk.out(h), direction], 1)), h
