"""Neural Volumes (Lombardi et al., SIGGRAPH 2019): a network decodes a code to a volume and to warps of it.

Published: codes of 256 numbers, a template of 128^3 with colour and opacity, a mixture of 16 affine warps with weights
of 32^3, opacity that adds up along a ray until it is 1 (Section 4 and 5). Each moment has a code of its own that is
learned, in place of an encoder of pictures: the same cameras show all moments here.
"""

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
from devrf.lab.methods.networks import Codes
from devrf.reconstruct.rendering.rays import RayBatch

SETTINGS: dict[Size, Settings] = {
    "small": Settings(rays=512, samples=(64, 0), rate=4e-3, last_rate=4e-4),
    "full": Settings(rays=16384, samples=(128, 0), rate=1e-4, last_rate=1e-5),
}
# code, side of the template and of the weights, warps, channels of the widest layer
SIZES = {"small": (64, 32, 16, 8, 64), "full": (256, 128, 32, 16, 512)}
VARIATION = (
    1e-4  # of the logarithm of opacity; published 0.01, beside squared errors that are summed, not averaged
)
NARROWEST = 8  # channels
PLAIN = "it models a box before a plain background, and the scene shows its surroundings"


def decoder(code: int, side: int, channels: int, widest: int) -> nn.Sequential:
    """From a code to a volume: every layer doubles its sides."""
    layers: list[nn.Module] = [nn.Linear(code, widest), nn.LeakyReLU(0.2), nn.Unflatten(1, (widest, 1, 1, 1))]
    width, now = widest, 1
    while now < side:
        now *= 2
        narrower = channels if now == side else max(NARROWEST, width // 2)
        layers.append(nn.ConvTranspose3d(width, narrower, 4, 2, 1))
        layers += [nn.LeakyReLU(0.2)] if now < side else []
        width = narrower
    return nn.Sequential(*layers)


class NeuralVolumes(RadianceField):
    """Codes of moments, a decoder of a template, and one of warps."""

    one_moment = True

    def __init__(self, size: Size, moments: Float[Tensor, " t"]) -> None:
        super().__init__()
        code, side, warp_side, self.warps, widest = SIZES[size]
        self.codes = Codes(moments, code)
        self.rest_code = nn.Parameter(torch.zeros(code))
        self.template = decoder(code, side, 4, widest)
        self.shares = decoder(code, warp_side, self.warps, widest // 2)
        self.affine = nn.Linear(code, 12 * self.warps)
        nn.init.uniform_(self.affine.weight, -1e-3, 1e-3)
        with torch.no_grad():  # copies of the whole, a little apart
            self.affine.bias.copy_((torch.eye(3, 4) + 0.02 * torch.randn(self.warps, 3, 4)).ravel())

    def forward(self, points: FieldPoints) -> Sampled:
        """The template where points come from."""
        density, rgb, variation = points.time.new_zeros(len(points.x)), torch.zeros_like(points.x), []
        key = torch.where(points.rest > 0, -1.0, points.time)
        for moment in key.unique():
            mine = key == moment
            code = self.rest_code if moment < 0 else self.codes(moment[None])[0]
            volume = self.template(code[None])
            found = looked_up(volume, self.warped(points.x[mine], code))
            rgb = rgb.index_put((mine,), torch.sigmoid(found[:, :3]))
            density = density.index_put((mine,), dense(found[:, 3]))
            opacity = torch.log(dense(volume[:, 3]) + 1e-3)
            variation.append(torch.stack([opacity.diff(dim=k).abs().mean() for k in (1, 2, 3)]).sum())
        return Sampled(density, rgb, {"variation": torch.stack(variation).mean()})

    def warped(self, x: Float[Tensor, "n 3"], code: Float[Tensor, " c"]) -> Float[Tensor, "n 3"]:
        """Where points come from: a mixture of affine warps, weighted where each leads (their Eq. 9 and 10)."""
        A = self.affine(code).reshape(self.warps, 3, 4)
        each = torch.einsum("kij,nj->kni", A[..., :3], x) + A[:, None, :, 3]
        shares = self.shares(code[None])[0]  # [k, s, s, s]
        weight = torch.stack([looked_up(s[None, None], at)[:, 0] for s, at in zip(shares, each, strict=True)])
        inside = (each.abs() <= 1).all(-1).float()
        weight = torch.exp(weight) * inside + 1e-6
        return (each * (weight / weight.sum(0))[..., None]).sum(0)

    def weights(
        self, density: Float[Tensor, "R n"], t: Float[Tensor, "R n"], last: Float[Tensor, " R"]
    ) -> Float[Tensor, "R n"]:
        """Opacity adds up until it is 1 (their Eq. 4)."""
        gaps = torch.diff(t, dim=1, append=last[:, None]).clamp(min=0)
        whole = torch.cumsum(density * gaps, 1).clamp(max=1)
        return torch.diff(whole, dim=1, prepend=torch.zeros_like(whole[:, :1]))

    def losses(self, field: FieldTraining, rays: RayBatch, seen: RenderedRays) -> dict[str, Tensor]:
        """Opacity is even."""
        return {"variation": VARIATION * seen.more["variation"]}


def looked_up(volume: Float[Tensor, "1 c d h w"], at: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
    """Values of a volume at places in [-1, 1], trilinear."""
    found = nn.functional.grid_sample(volume, at[None, None, None], align_corners=True, padding_mode="border")
    return found[0, :, 0, 0].T


METHOD = FieldMethod(
    lambda task, pictures: NeuralVolumes(task.size, pictures.moments), SETTINGS, only_plain=PLAIN
)
