"""RAFT's network, small and large: recurrent all-pairs field transforms (Teed & Deng, ECCV 2020, arXiv 2003.12039).

Written from the paper; parameters carry the names of the authors' checkpoints, so that these load. Everything works
on an eighth of the picture's size: features of both pictures are correlated (`correlation.py`), and a gated unit
corrects the flow step by step by what the correlation around its present end shows.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from devrf.flow.raft.correlation import LEVELS, VOLUME_BYTES, CorrelationPyramid

STRIDE = 8  # of features, pixels
MASK_GAIN = 0.25  # the authors'; it slows the mask's training, and belongs to the weights


@dataclass(frozen=True)
class Sizes:
    """What tells the two networks apart: numbers of channels, and the radius of a look.

    Attributes:
        name: small or large.
        stem, blocks, features: Of the encoders: first convolution, three pairs of blocks, what comes out.
        hidden, context: Of the gated unit: its state, and what it is told of the first picture.
        correlation, motion, joined: Of the motion encoder: from correlation, from flow, from both.
        head: Of the convolution before the flow.
        radius: In cells of an eighth, on each level.
    """

    name: str
    stem: int
    blocks: tuple[int, int, int]
    features: int
    hidden: int
    context: int
    correlation: tuple[int, ...]
    motion: tuple[int, int]
    joined: int
    head: int
    radius: int


SMALL = Sizes("small", 32, (32, 64, 96), 128, 96, 64, (96,), (64, 32), 80, 128, 3)
LARGE = Sizes("large", 64, (64, 96, 128), 256, 128, 128, (256, 192), (128, 64), 126, 256, 4)


class Raft(nn.Module):
    """The network of one size."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        small = sizes == SMALL
        self.fnet = _Encoder(sizes, sizes.features, nn.InstanceNorm2d, small)
        norm = nn.Identity if small else nn.BatchNorm2d
        self.cnet = _Encoder(sizes, sizes.hidden + sizes.context, norm, small)
        self.update_block = _Update(sizes, small)

    def forward(
        self,
        image0: Float[Tensor, "3 H W"],
        image1: Float[Tensor, "3 H W"],
        steps: int,
        volume_bytes: int = VOLUME_BYTES,
    ) -> Float[Tensor, "2 H W"]:
        """Flow from image0 to image1 (RGB from -1 to 1, sides multiples of 8), pixels, after some steps."""
        features = self.fnet(torch.stack([image0, image1])).float()
        state, context = self.cnet(image0[None]).split([self.sizes.hidden, self.sizes.context], dim=1)
        state, context = state.tanh(), context.relu()
        with torch.autocast(image0.device.type, enabled=False):  # the authors correlate in single precision
            pyramid = CorrelationPyramid(features[0], features[1], self.sizes.radius, volume_bytes)
        y, x = (torch.arange(n, device=image0.device, dtype=torch.float32) for n in features.shape[2:])
        begin = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        flow = torch.zeros_like(begin)
        for _ in range(steps):
            with torch.autocast(image0.device.type, enabled=False):
                seen = pyramid.around(begin + flow)
            state, more = self.update_block(state, context, seen[None], flow.permute(2, 0, 1)[None])
            flow = flow + more[0].float().permute(1, 2, 0)
        low = STRIDE * flow.permute(2, 0, 1)[None]
        mask = self.update_block.mask
        return (_enlarged(low) if mask is None else _convex(low, MASK_GAIN * mask(state).float()))[0]


def _enlarged(low: Float[Tensor, "1 2 h w"]) -> Float[Tensor, "1 2 H W"]:
    """Eight times the size; corners stay corners, as the small network was trained."""
    return F.interpolate(low, scale_factor=STRIDE, mode="bilinear", align_corners=True)


def _convex(low: Float[Tensor, "1 2 h w"], mask: Float[Tensor, "1 c h w"]) -> Float[Tensor, "1 2 H W"]:
    """Eight times the size: each new vector is a weighted mean of the nine around it (Section 3.3)."""
    height, width = low.shape[2:]
    weights = mask.view(9, STRIDE, STRIDE, height, width).softmax(dim=0)
    around = F.unfold(low, 3, padding=1).view(2, 9, height, width)
    out = torch.einsum("kijhw,ckhw->chiwj", weights, around)
    return out.reshape(1, 2, STRIDE * height, STRIDE * width)


class _Encoder(nn.Module):
    """Features at an eighth of the size."""

    def __init__(self, sizes: Sizes, out: int, norm, small: bool) -> None:
        super().__init__()
        self.conv1, self.norm1 = nn.Conv2d(3, sizes.stem, 7, 2, 3), norm(sizes.stem)
        block = _Bottleneck if small else _Residual
        before = sizes.stem
        for n, (channels, stride) in enumerate(zip(sizes.blocks, (1, 2, 2), strict=True), 1):
            pair = nn.Sequential(block(before, channels, stride, norm), block(channels, channels, 1, norm))
            self.add_module(f"layer{n}", pair)
            before = channels
        self.conv2 = nn.Conv2d(before, out, 1)

    def forward(self, x: Float[Tensor, "n 3 H W"]) -> Float[Tensor, "n c h w"]:
        x = self.norm1(self.conv1(x)).relu()
        for n in (1, 2, 3):
            x = self.get_submodule(f"layer{n}")(x)
        return self.conv2(x)


class _Block(nn.Module):
    """Convolutions with a way around them."""

    def __init__(self, layers: list[nn.Conv2d], before: int, stride: int, norm) -> None:
        super().__init__()
        for n, conv in enumerate(layers, 1):
            self.add_module(f"conv{n}", conv)
            self.add_module(f"norm{n}", norm(conv.out_channels))
        self.count, out = len(layers), layers[-1].out_channels
        around = nn.Sequential(nn.Conv2d(before, out, 1, stride), norm(out))
        self.downsample = around if stride > 1 else nn.Identity()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d i j"]:
        y = x
        for n in range(1, self.count + 1):
            y = self.get_submodule(f"norm{n}")(self.get_submodule(f"conv{n}")(y)).relu()
        return (self.downsample(x) + y).relu()


class _Residual(_Block):
    def __init__(self, before: int, out: int, stride: int, norm) -> None:
        layers = [nn.Conv2d(before, out, 3, stride, 1), nn.Conv2d(out, out, 3, 1, 1)]
        super().__init__(layers, before, stride, norm)


class _Bottleneck(_Block):
    def __init__(self, before: int, out: int, stride: int, norm) -> None:
        quarter = out // 4
        layers = [
            nn.Conv2d(before, quarter, 1),
            nn.Conv2d(quarter, quarter, 3, stride, 1),
            nn.Conv2d(quarter, out, 1),
        ]
        super().__init__(layers, before, stride, norm)


class _Update(nn.Module):
    """One correction of the flow."""

    def __init__(self, sizes: Sizes, small: bool) -> None:
        super().__init__()
        self.encoder = _MotionEncoder(sizes)
        self.gru = _Gru(sizes, (("", (3, 3)),) if small else (("1", (1, 5)), ("2", (5, 1))))
        self.flow_head = nn.Sequential()
        self.flow_head.add_module("conv1", nn.Conv2d(sizes.hidden, sizes.head, 3, padding=1))
        self.flow_head.add_module("relu", nn.ReLU())
        self.flow_head.add_module("conv2", nn.Conv2d(sizes.head, 2, 3, padding=1))
        nine = nn.Conv2d(2 * sizes.hidden, 9 * STRIDE**2, 1)
        self.mask = (
            None
            if small
            else nn.Sequential(nn.Conv2d(sizes.hidden, 2 * sizes.hidden, 3, padding=1), nn.ReLU(), nine)
        )

    def forward(
        self, state: Tensor, context: Tensor, seen: Tensor, flow: Float[Tensor, "1 2 h w"]
    ) -> tuple[Tensor, Float[Tensor, "1 2 h w"]]:
        state = self.gru(state, torch.cat([context, self.encoder(seen, flow)], dim=1))
        return state, self.flow_head(state)


class _MotionEncoder(nn.Module):
    """Correlation and present flow together."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        before = LEVELS * (2 * sizes.radius + 1) ** 2
        self.looks = len(sizes.correlation)
        for n, out in enumerate(sizes.correlation, 1):
            side = 1 if n == 1 else 3
            self.add_module(f"convc{n}", nn.Conv2d(before, out, side, padding=side // 2))
            before = out
        self.convf1 = nn.Conv2d(2, sizes.motion[0], 7, padding=3)
        self.convf2 = nn.Conv2d(sizes.motion[0], sizes.motion[1], 3, padding=1)
        self.conv = nn.Conv2d(before + sizes.motion[1], sizes.joined, 3, padding=1)

    def forward(self, seen: Float[Tensor, "1 c h w"], flow: Float[Tensor, "1 2 h w"]) -> Tensor:
        for n in range(1, self.looks + 1):
            seen = self.get_submodule(f"convc{n}")(seen).relu()
        moved = self.convf2(self.convf1(flow).relu()).relu()
        return torch.cat([self.conv(torch.cat([seen, moved], dim=1)).relu(), flow], dim=1)


class _Gru(nn.Module):
    """Gated recurrent unit of convolutions; the large network has one along rows, then one along columns."""

    def __init__(self, sizes: Sizes, passes: tuple[tuple[str, tuple[int, int]], ...]) -> None:
        super().__init__()
        self.passes = tuple(name for name, _ in passes)
        before = sizes.hidden + sizes.context + sizes.joined + 2
        for name, kernel in passes:
            around = (kernel[0] // 2, kernel[1] // 2)
            for gate in "zrq":
                conv = nn.Conv2d(before, sizes.hidden, kernel, padding=around)
                self.add_module(f"conv{gate}{name}", conv)

    def forward(self, state: Tensor, told: Tensor) -> Tensor:
        for name in self.passes:
            z, r, q = (self.get_submodule(f"conv{gate}{name}") for gate in "zrq")
            both = torch.cat([state, told], dim=1)
            keep = z(both).sigmoid()
            new = q(torch.cat([r(both).sigmoid() * state, told], dim=1)).tanh()
            state = (1 - keep) * state + keep * new
        return state
