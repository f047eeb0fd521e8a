"""Neural scene flow fields (Li et al., CVPR 2021): a field in four dimensions that says where everything goes next.

Published: two networks of 8 layers of 256 for what stands and what moves, ten frequencies of places and times, 128
samples; scene flow to the moments before and after, weights of occlusion, and a blend with what stands (Eq. 2 to 9).
Losses by their weights: cycle 1, scene flow small 0.1, even 0.1, optical flow 0.02 that fades. Without the depth of a
single picture, which they also use: the sweep tells depth here.
"""

import torch
from jaxtyping import Bool, Float
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
    quadrature,
    spread_out,
)
from devrf.lab.methods.method_table import Size
from devrf.lab.methods.networks import FREQUENCIES, Encoding, Mlp, RadianceMlp
from devrf.reconstruct.rendering.rays import RayBatch

SETTINGS: dict[Size, Settings] = {
    "small": Settings(rays=256, samples=(32, 0), rate=5e-3, last_rate=5e-4),
    "full": Settings(rays=1024, samples=(128, 0), rate=5e-4, last_rate=5e-5),
}
NETWORKS = {"small": (4, 96), "full": (8, 256)}  # depth and width
CYCLE, LITTLE, EVEN, FLOW, OCCLUDED = 1.0, 0.1, 0.1, 0.02, 0.1
FLOW_FADES = 0.5  # of the budget, after which optical flow counts a tenth
STEP = 0.3  # of the space, that a point goes in a moment at most
PIXELS = 1 / 400  # optical flow in widths of a picture


class SceneFlow(RadianceField):
    """What stands, what moves, and where that goes.

    Attributes:
        gap: Between two moments.
    """

    def __init__(self, size: Size, moments: Float[Tensor, " t"]) -> None:
        super().__init__()
        depth, width = NETWORKS[size]
        self.place, self.direction, self.time = (
            Encoding(3, FREQUENCIES[size]),
            Encoding(3, 4),
            Encoding(1, FREQUENCIES[size]),
        )
        self.stands = RadianceMlp(self.place.size, depth, width, self.direction.size)
        self.blend = Mlp(self.place.size, 1, 2, width // 2, None)
        self.moves = RadianceMlp(self.place.size + self.time.size, depth, width, self.direction.size)
        self.flow = nn.Linear(width, 8)  # forward, backward, weights of occlusion of both
        nn.init.uniform_(self.flow.weight, -1e-4, 1e-4)
        nn.init.zeros_(self.flow.bias)
        self.gap = float(moments.diff().median()) if len(moments) > 1 else 1.0
        self.share = 0.0

    def forward(self, points: FieldPoints) -> Sampled:
        """What stands and what moves, blended (their Eq. 7)."""
        place, direction = self.place(points.x), self.direction(points.d)
        density, rgb, _ = self.stands(place, direction)
        density = dense(density)
        rest = points.rest[:, None]
        blend = torch.lerp(torch.sigmoid(self.blend(place)), torch.ones_like(rest), rest)[:, 0]
        moving, colour, out = self.dynamic(points)
        both = blend * density + (1 - blend) * moving
        mixed = (blend * density)[:, None] * rgb + ((1 - blend) * moving)[:, None] * colour
        mixed = mixed / both.clamp(min=1e-6)[:, None]
        return Sampled(both, mixed, {"density": moving, "rgb": colour, "out": out})

    def dynamic(
        self, points: FieldPoints
    ) -> tuple[Float[Tensor, " n"], Float[Tensor, "n 3"], Float[Tensor, "n 8"]]:
        """Density and colour of what moves; flows and weights of occlusion before their activations."""
        encoded = torch.cat([self.place(points.x), self.time(2 * points.time[:, None] - 1)], 1)
        density, rgb, features = self.moves(encoded, self.direction(points.d))
        return dense(density), rgb, self.flow(features)

    def advance(self, share: float) -> None:
        """How far training is."""
        self.share = share

    def still(self) -> list[nn.Parameter]:
        """What stands."""
        return list(self.stands.parameters())

    def losses(self, field: FieldTraining, rays: RayBatch, seen: RenderedRays) -> dict[str, Tensor]:
        """What moves looks the same a moment before and after where its flow leads; flows are small and even."""
        who = rays.frame >= 0
        if not bool(who.any()):
            return {}
        n, own = seen.t.shape[1], who.repeat_interleave(seen.t.shape[1])
        density, rgb, out = (seen.more[name][own] for name in ("density", "rgb", "out"))
        x = seen.x[who].reshape(-1, 3)
        t, last = seen.t[who], field.last(rays)[who]
        d, time = rays.rays_d[who].repeat_interleave(n, 0), rays.time[who].repeat_interleave(n)
        weights = quadrature(density.reshape(-1, n), t, last)
        now, _ = field.composed(weights, rgb.reshape(-1, n, 3), t)
        true = rays.rgb[who]
        found = {"moving": ((now - true) ** 2).mean()}
        flows, visible = STEP * torch.tanh(out[:, :6]).reshape(-1, 2, 3), torch.sigmoid(out[:, 6:] + 2)
        for k, sign in ((0, 1.0), (1, -1.0)):
            inside = ((time + sign * self.gap >= -1e-6) & (time + sign * self.gap <= 1 + 1e-6)).float()
            there = FieldPoints(x + flows[:, k], d, time + sign * self.gap, torch.zeros_like(time))
            other, colour, back = self._elsewhere(field, there)
            back = STEP * torch.tanh(back[:, :6]).reshape(-1, 2, 3)[:, 1 - k]
            warped = quadrature(other.reshape(-1, n), t, last)
            picture, _ = field.composed(warped, colour.reshape(-1, n, 3), t)
            seen_there = (warped.detach() * visible[:, k].reshape(-1, n)).sum(1) * inside.reshape(-1, n)[:, 0]
            found[f"warped{k}"] = (seen_there[:, None] * (picture - true) ** 2).mean()
            found[f"occluded{k}"] = OCCLUDED * (inside * (1 - visible[:, k])).mean()
            cycle = (flows[:, k] + back).abs().sum(1)
            found[f"cycle{k}"] = CYCLE * (inside * visible[:, k].detach() * cycle).mean()
        found["little"] = LITTLE * (flows.abs().mean() + (flows.sum(1) ** 2).mean())
        found["even"] = EVEN * flows.reshape(-1, n, 6).diff(dim=1).abs().mean()
        return found | self._optical(field, rays, who, weights, x.reshape(-1, n, 3), flows[:, 1])

    def _elsewhere(self, field: FieldTraining, points: FieldPoints) -> tuple[Tensor, ...]:
        """As `dynamic`; nothing where nothing can be."""
        where = field.space.may_hold(points.x)
        where[:1] = True  # asked of something
        return tuple(spread_out(values, where) for values in self.dynamic(points.only(where)))

    def _optical(
        self,
        field: FieldTraining,
        rays: RayBatch,
        who: Bool[Tensor, " R"],
        weights: Float[Tensor, "r n"],
        x: Float[Tensor, "r n 3"],
        back: Float[Tensor, "rn 3"],
    ) -> dict[str, Tensor]:
        """Where the picture before shows what is seen now (their Eq. 12)."""
        flow = field.pictures.flow
        if flow is None:
            return {}
        target, before, trusted, _ = flow.at(rays.frame[who], rays.pixel[who])
        share = weights / weights.sum(1, keepdim=True).clamp(min=1e-6)
        came = (share[..., None] * (x + back.reshape(x.shape))).sum(1)
        off = flow.project(field.space.expanded(came), before) - target
        fades = 0.1 ** min(1.0, self.share / FLOW_FADES)
        return {"flow": FLOW * fades * PIXELS * (trusted[:, None] * off).abs().mean()}


METHOD = FieldMethod(lambda task, pictures: SceneFlow(task.size, pictures.moments), SETTINGS)
