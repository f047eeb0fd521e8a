"""The trained model as a function of place and time: how dense it is there, where that rests, and of which colour.

Points are given in the coordinates of the model's grids, which are the box frame, or the reference camera's normalised
device coordinates (`ndc.py`); `to_box` and `from_box` lead from one to the other. What is empty for the march is
empty here: the density is 0 beyond the box of the scene at rest and where its occupancy says so.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Float32, Int
from torch import Tensor

from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.carried import part_of, to_rest
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import Movers, Placed
from devrf.reconstruct.kernels.trilinear import trilinear
from devrf.reconstruct.rendering.model import DynamicModel

AT_ONCE = 1 << 18  # points; each needs about 200 bytes on its way


@dataclass(frozen=True)
class Field:
    """The scene at one time. Methods work on any number of points; `blocks` cuts many into parts.

    Attributes:
        canonical: The scene at rest, as it is rendered at this time.
        motion: The two key times around the time; None: the scene is at rest.
        tau: Of the time, in spacings of those two [1].
        movers: Rigid parts and where they are at the time, where motion is theirs; `canonical` is what stands then.
    """

    canonical: Canonical
    motion: MotionField | None = None
    tau: Float[Tensor, "1"] | None = None
    movers: tuple[Movers, Placed] | None = None

    @property
    def aabb(self) -> Float[Tensor, "2 3"]:
        """Box outside which there is nothing, in the coordinates of the grids; on the CPU."""
        return self.canonical.aabb if self.motion is None else self.motion.aabb

    @property
    def voxel(self) -> float:
        """Side of a voxel of the scene at rest; the distance of two planes where the grids are planes."""
        canonical = self.canonical
        return canonical.step / canonical.stepsize

    @property
    def shape(self) -> tuple[int, int, int]:
        """Vertices along each axis of a grid over the box, as far apart as those of the scene at rest."""
        rest, cells = self.canonical.aabb, torch.tensor(self.canonical.shape) - 1
        step = (rest[1] - rest[0]) / cells
        x, y, z = (max(2, round(n) + 1) for n in ((self.aabb[1] - self.aabb[0]) / step).tolist())
        return x, y, z

    def at_rest(self) -> "Field":
        """The same scene before it moved."""
        movers = self.movers and (self.movers[0], self.movers[0].at_rest(torch.zeros(1)))
        return replace(self, motion=None, tau=None, movers=movers)

    def to_rest(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Where points seen at this time rest (backward motion)."""
        if self.movers is not None:
            return self.layer(x)[0]
        return x if self.motion is None else self.motion.to_rest(x, _taus(self, x))

    def from_rest(self, x_rest: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Where resting points are at this time (forward motion)."""
        if self.movers is not None:
            movers, placed = self.movers
            return placed.carried(x_rest, part_of(movers, x_rest))
        return x_rest if self.motion is None else self.motion.from_rest(x_rest, _taus(self, x_rest))

    @torch.no_grad()
    def density(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        """Extinction at points: what absorbs light, per unit of the grids' coordinates (NDC: along z')."""
        if self.movers is None:
            return _density(self.canonical, self.to_rest(x))
        movers, placed = self.movers
        x0, part = to_rest(movers, x, placed)
        moving = torch.where(part > 0, _density(movers.canonical, x0), 0.0)
        return _density(self.canonical, x) + moving

    @torch.no_grad()
    def features(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n c"]:
        """Colour features at points."""
        if self.movers is None:
            return self.canonical.features_at(self.to_rest(x))
        x0, part = self.layer(x)
        there = self.movers[0].canonical.features_at(x0)
        return torch.where((part > 0)[:, None], there, self.canonical.features_at(x))

    @torch.no_grad()
    def colours(self, x: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """RGB in [0, 1] of points in the light at rest, each seen in a direction of its own (unit vectors in the box
        frame, away from the camera)."""
        return self.canonical.net(self.features(x), rays_d, torch.arange(len(x), device=x.device))

    def to_box(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points in the box frame."""
        return x if self.canonical.ndc is None else self.canonical.ndc.to_world(x)

    def from_box(self, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Points of the box frame in the coordinates of the grids; NDC: they lie before the reference camera."""
        return x if self.canonical.ndc is None else self.canonical.ndc.from_world(x)

    def layer(self, x: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
        """Where points rest, and the part of the movers that they are on; 0: on what stands."""
        assert self.movers is not None  # asked where there are some
        movers, placed = self.movers
        x0, part = to_rest(movers, x, placed)
        part = torch.where(_density(movers.canonical, x0) > _density(self.canonical, x), part, 0)
        return torch.where((part > 0)[:, None], x0, x), part


def opacity(field: Field, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    """How much of the light a layer of a voxel's thickness absorbs, in [0, 1]: 0.5 and more looks solid."""
    return 1 - torch.exp(-field.voxel * field.density(x))


@torch.no_grad()
def brightness(field: Field, x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1"]:
    """Factor on colours at points: the shading of movers at this time, one where there is none."""
    if field.movers is None or field.movers[0].shading is None:
        return torch.ones_like(x[:, :1])
    (place, part), time = field.layer(x), field.movers[1].times.expand(len(x))
    return field.movers[0].shading.at((part > 0).long(), place, time).exp()[:, None]


def colours_from_outside(
    field: Field, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """RGB in [0, 1] of surface points in the box frame, each looked at against its outward unit normal."""
    device, out = field.canonical.density.device, np.empty(points.shape)
    for first in range(0, len(points), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        x = torch.from_numpy(points[part].astype(np.float32)).to(device)
        rays_d = torch.from_numpy(-normals[part].astype(np.float32)).to(device)
        out[part] = field.colours(field.from_box(x), rays_d).cpu().numpy()
    return out


def blocks(field: Field, shape: tuple[int, int, int]) -> Iterator[tuple[slice, Float[Tensor, "n 3"]]]:
    """The vertices of a grid over the box, some planes of its first axis at a time, with where those are."""
    lines = vertices(field.aabb, (2, *shape[1:]))[0]  # of one plane; its x is put in below
    xs = torch.linspace(float(field.aabb[0, 0]), float(field.aabb[1, 0]), shape[0])
    planes = max(1, AT_ONCE // (shape[1] * shape[2]))
    for first in range(0, shape[0], planes):
        part = slice(first, min(first + planes, shape[0]))
        x = lines.expand(part.stop - part.start, *lines.shape).clone()
        x[..., 0] = xs[part, None, None]
        yield part, x.reshape(-1, 3).to(field.canonical.density.device)


def opacity_grid(field: Field, shape: tuple[int, int, int]) -> Float32[Tensor, "X Y Z"]:
    """`opacity` at the vertices of a grid over the box, on the CPU."""
    out = torch.empty(shape)
    for part, x in blocks(field, shape):
        out[part] = opacity(field, x).reshape(-1, *shape[1:]).cpu()
    return out


def field_at(model: DynamicModel, time: float | None) -> Field:
    """The scene at a time in [0, 1], or at rest (None, or nothing moves), as `render_view` shows it."""
    if model.motion is None or time is None:
        return Field(model.rest.canonical)
    motion, tau = model.motion.at(time, model.rest.canonical.density.device)
    if model.movers is not None and model.in_motion is not None:
        placed = model.movers.placed(torch.tensor([time]))
        return Field(model.in_motion.canonical, motion, tau, (model.movers, placed))
    return Field((model.in_motion or model.rest).canonical, motion, tau)


@torch.no_grad()
def moved(
    model: DynamicModel, points: Float[np.ndarray, "n 3"], time: float | None, then: float | None
) -> Float[np.ndarray, "n 3"]:
    """Where points of the box frame, seen at a time in [0, 1], are at another one; None: at rest."""
    if model.motion is None or time == then or not len(points):
        return points
    x = torch.from_numpy(points.astype(np.float32)).to(model.rest.canonical.density.device)
    if model.movers is not None and model.in_motion is not None:
        movers = model.movers

        def placed(moment: float | None) -> Placed:
            time = torch.tensor([moment or 0.0])
            return movers.at_rest(time) if moment is None else movers.placed(time)

        x_rest, part = Field(model.in_motion.canonical, movers=(movers, placed(time))).layer(x)
        return placed(then).carried(x_rest, part).cpu().numpy().astype(np.float64)
    now, other = field_at(model, time), field_at(model, then)
    x_rest = now.to_rest(now.from_box(x))
    return other.to_box(other.from_rest(x_rest)).cpu().numpy().astype(np.float64)


def _density(canonical: Canonical, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    raw = trilinear(canonical.density, x, canonical.aabb)[:, 0]
    dense = F.softplus(raw + canonical.shift) / canonical.base_voxel
    return torch.where(_occupied(canonical, x), dense, 0.0)


def _occupied(canonical: Canonical, x: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    """Whether points at rest lie in the box, next to an occupied vertex: those that the march looks at."""
    lo, hi = canonical.aabb.to(x)
    last = torch.tensor(canonical.shape, device=x.device) - 1
    vertex = (x - lo) / (hi - lo) * last
    inside = ((vertex >= 0) & (vertex <= last)).all(-1)
    near = torch.minimum((vertex + 0.5).floor().clamp(min=0), last.to(x)).long()
    return inside & (canonical.distance[tuple(near.unbind(-1))] == 0)


def _taus(field: Field, x: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
    assert field.tau is not None
    return field.tau.to(x).expand(len(x)).contiguous()
