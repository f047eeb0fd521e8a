"""Where splats of the scene at rest are at a time: they move by the forward field, or on a node for each rigid part."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.geometry.field import Field, field_at
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.splats.gaussians import Gaussians, product, quats_of, rotations


@dataclass(frozen=True)
class Nodes:
    """What stands (node 0, which stays) and rigid parts at some times: x at rest is at q (x - middle) + place.

    Attributes:
        part: Node of each splat.
        middles: Of the nodes at rest, about which they turn between the times.
        quats, places: Unit quaternions w x y z, and where the middles are, at each time.
    """

    part: Int[Tensor, " N"]
    middles: Float[Tensor, "P 3"]
    quats: Float[Tensor, "K P 4"]
    places: Float[Tensor, "K P 3"]

    def at(self, key: int, gaussians: Gaussians) -> Gaussians:
        """Resting splats at one of the times, turned with their parts; differentiable."""
        quats = self.quats[key, self.part]
        turned = torch.einsum("nij,nj->ni", rotations(quats), gaussians.places - self.middles[self.part])
        there = self.places[key, self.part] + turned
        return replace(gaussians, places=there, quats=product(quats, gaussians.quats))

    def then(self, model: DynamicModel, times: Sequence[float | None]) -> "Nodes":
        """The same nodes at other times in [0, 1]; None: at rest."""
        assert model.movers is not None  # they are its parts
        quats, places = (
            self.middles.new_zeros(len(times), len(self.middles), 4),
            self.middles.repeat(len(times), 1, 1),
        )
        quats[..., 0] = 1
        for key, time in enumerate(times):
            if time is not None:
                placed = model.movers.placed(torch.tensor([time]))
                quats[key, 1:] = quats_of(placed.rotations[0])
                turned = torch.einsum("pij,pj->pi", placed.rotations[0], self.middles[1:])
                places[key, 1:] = turned + placed.shifts[0]
        return replace(self, quats=quats, places=places)


@torch.no_grad()
def nodes_of(
    model: DynamicModel, x_rest: Float[Tensor, "N 3"], times: Sequence[float | None]
) -> Nodes | None:
    """The parts of resting points, and where these are at times (None: at rest); None where not all are rigid."""
    if model.movers is None or model.movers.stretches is not None or model.in_motion is None:
        return None
    movers, at_rest = model.movers, model.movers.at_rest(torch.zeros(1))
    part = Field(model.in_motion.canonical, movers=(movers, at_rest)).layer(x_rest)[1]
    middles = torch.cat([torch.zeros(1, 3), torch.from_numpy(movers.middles()).float()]).to(x_rest)
    never = middles.new_zeros(0, len(middles), 4)
    return Nodes(part, middles, never, never[..., :3]).then(model, times)


@torch.no_grad()
def moved(model: DynamicModel, x_rest: Float[Tensor, "N 3"], time: float | None) -> Float[Tensor, "N 3"]:
    """Where resting points are at a time (None: at rest), in the box frame; nothing moves outside the motion's box."""
    field = field_at(model, time)
    if field.motion is None:
        return x_rest
    rest = field.from_box(x_rest)
    lo, hi = field.aabb.to(rest)
    inside = ((rest >= lo) & (rest <= hi)).all(1)
    return torch.where(inside[:, None], field.to_box(field.from_rest(rest)), x_rest)
