"""Nerfies (Park et al., ICCV 2021): a field of rigid motions, elastic, sharpened from coarse to fine.

Published: a template of 8 layers of 256, a deformation network of 6 of 128 with 8 frequencies, codes of 8 numbers for
deformation and appearance (Section 4); elastic loss of weight 1e-3 on the logarithms of singular values with Geman
and McClure's robust loss, c = 0.03 (Eq. 6 and 7); the window opens over 80,000 steps,
here over `WINDOW` of the budget. Points that stand are told to stay (their Section 3.4): those of the sweep outside the
box.
"""

import kornia
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
from devrf.lab.methods.networks import FREQUENCIES, Codes, Encoding, Mlp, RadianceMlp
from devrf.reconstruct.rendering.rays import RayBatch

SETTINGS: dict[Size, Settings] = {
    "small": Settings(rays=256, samples=(24, 24), rate=5e-3, last_rate=5e-4),
    "full": Settings(rays=6144, samples=(128, 128), rate=1e-3, last_rate=1e-4),
}
TEMPLATE = {"small": (4, 96), "full": (8, 256)}  # depth and width
WARP = {"small": (4, 64), "full": (6, 128)}
CODE = 8
SPREAD: dict[Size, float] = {"small": 0.5, "full": 0.05}  # of codes of deformation at first
WARP_FREQUENCIES: dict[Size, int] = {"small": 4, "full": 8}
WARP_SHARE: dict[Size, float] = {"small": 0.2, "full": 1.0}  # of the rate
WINDOW = 0.4  # of the budget until all frequencies of the deformation count
ELASTIC, ROBUST = 1e-3, 0.03
STAYS = 1.0  # weight of the loss by which what stands stays
ELASTIC_POINTS: dict[Size, int] = {
    "small": 64,
    "full": 256,
}  # of a batch: each costs three more passes backward


class RigidWarp(nn.Module):
    """A rigid motion at every place (their Eq. 2 to 4)."""

    def __init__(self, size: Size, moments: Float[Tensor, " t"]) -> None:
        super().__init__()
        depth, width = WARP[size]
        self.codes, self.place = Codes(moments, CODE, SPREAD[size]), Encoding(3, WARP_FREQUENCIES[size])
        self.motion = Mlp(self.place.size + CODE, 6, depth, width, small=1e-4)

    def forward(self, x: Float[Tensor, "n 3"], code: Float[Tensor, "n c"]) -> Float[Tensor, "n 3"]:
        """Where points at `x` come from."""
        return moved(x, self.motion(torch.cat([self.place(x), code], 1)))

    def advance(self, share: float) -> None:
        """Open the window."""
        self.place.alpha = self.place.frequencies * min(1.0, share / WINDOW)


def moved(x: Float[Tensor, "n 3"], screw: Float[Tensor, "n 6"]) -> Float[Tensor, "n 3"]:
    """Points after screw motions: rotation vectors r and v with x' = exp(r) x + G(r) v (Lynch and Park 2017)."""
    r, v = screw[:, :3], screw[:, 3:]
    angle = r.norm(dim=1, keepdim=True).clamp(min=1e-6)
    rotation = kornia.geometry.conversions.axis_angle_to_rotation_matrix(r)
    cross, twice = torch.linalg.cross(r, v), torch.linalg.cross(r, torch.linalg.cross(r, v))
    along = v + (1 - angle.cos()) / angle**2 * cross + (angle - angle.sin()) / angle**3 * twice
    return (rotation @ x[..., None])[..., 0] + along


def elastic(jacobian: Float[Tensor, "n 3 3"]) -> Float[Tensor, " n"]:
    """Squared logarithms of a motion's singular values, robust: 0 for rotations (Eq. 6 and 7)."""
    singular = torch.linalg.svdvals(jacobian).clamp(min=1e-6)
    square = (singular.log() ** 2).sum(1) / ROBUST**2
    return 2 * square / (square + 4)


class Nerfies(RadianceField):
    """A template and rigid motions to it."""

    def __init__(self, size: Size, moments: Float[Tensor, " t"], more: int = 0) -> None:
        """The template is told `more` channels beside the place."""
        super().__init__()
        depth, width = TEMPLATE[size]
        self.warp_share = WARP_SHARE[size]
        self.warp = RigidWarp(size, moments)
        self.appearance = Codes(moments, CODE)
        self.place, self.direction = Encoding(3, FREQUENCIES[size]), Encoding(3, 4)
        self.canonical = RadianceMlp(self.place.size + more, depth, width, self.direction.size + CODE)

    def forward(self, points: FieldPoints) -> Sampled:
        """Density and colour where points come from."""
        moves = 1 - points.rest[:, None]
        code = self.warp.codes(points.time)
        x = torch.lerp(points.x, self.warp(points.x, code), moves)
        look = torch.cat([self.direction(points.d), self.appearance(points.time) * moves], 1)
        density, rgb, _ = self.canonical(torch.cat([self.place(x), *self.beside(points, code)], 1), look)
        return Sampled(dense(density), rgb, {})

    def beside(self, points: FieldPoints, code: Float[Tensor, "n c"]) -> list[Tensor]:
        """What the template is told beside the place."""
        return []

    def losses(self, field: FieldTraining, rays: RayBatch, seen: RenderedRays) -> dict[str, Tensor]:
        """Elastic where something is seen; what stands stays."""
        moving = rays.frame >= 0
        if not bool(moving.any()):
            return {}
        weight, time = seen.weights[moving].detach(), rays.time[moving]
        n = weight.shape[1]
        number = ELASTIC_POINTS[field.task.size]
        picked = torch.multinomial(weight.reshape(-1) + 1e-9, number, True)
        x = seen.x[moving].reshape(-1, 3)[picked].detach().requires_grad_()
        code = self.warp.codes(time[picked // n])
        there = self.warp(x, code)
        columns = [torch.autograd.grad(there[:, k].sum(), x, create_graph=True)[0] for k in range(3)]
        of_all = ELASTIC * weight.sum(1).mean()  # as the mean over rays of what each sample's weight counts
        return {"elastic": of_all * elastic(torch.stack(columns, 1)).mean()} | self._stays(field)

    def _stays(self, field: FieldTraining) -> dict[str, Tensor]:
        """Points of the sweep outside the box, which holds what moves, stay where they are."""
        points = field.task.boxed.points
        if points is None or field.task.regime == "dynamic":
            return {}
        number = ELASTIC_POINTS[field.task.size]
        pick = torch.randint(len(points.xyz), (number,), generator=field.generator).numpy()
        xyz = torch.from_numpy(points.xyz[pick]).float().to(field.task.device)
        outside = ((xyz < field.space.low) | (xyz > field.space.high)).any(1)
        x = field.space.contracted(xyz[outside])
        if not len(x):
            return {}
        moments = field.pictures.moments
        when = moments[torch.randint(len(moments), (len(x),), generator=field.generator)]
        return {"stays": STAYS * (self.warp(x, self.warp.codes(when)) - x).pow(2).sum(1).mean()}

    def advance(self, share: float) -> None:
        """Open the window of the deformation."""
        self.warp.advance(share)

    def rates(self) -> list[tuple[float, list[nn.Parameter]]]:
        """The motion more slowly where rates are large: else it folds before there is something to move."""
        moving = [*self.warp.motion.parameters(), *self.bent()]
        ids = {id(p) for p in moving}
        return [
            (self.warp_share, moving),
            (1.0, [p for p in self.parameters() if id(p) not in ids]),
        ]

    def bent(self) -> list[nn.Parameter]:
        """Parameters, beside those of the warp, that say how the template is cut."""
        return []

    def still(self) -> list[nn.Parameter]:
        """The template."""
        return list(self.canonical.parameters())


METHOD = FieldMethod(lambda task, pictures: Nerfies(task.size, pictures.moments), SETTINGS)
