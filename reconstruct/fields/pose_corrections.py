"""Small corrections of where parts are, learned from pictures together with how they look."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.movers import Movers, Placed, symmetric


class Corrections(torch.nn.Module):
    """For each part at each moment a turn about its middle, a shift and a stretch; linear between moments.

    Attributes:
        values: Turns, as rotation vectors times the radius of the part, and shifts; where parts are soft also what is
            added to their stretches, the entries `UPPER` times the radius [T, M, 6 or 12]. All in box units, so that
            one rate of learning fits all.
    """

    def __init__(self, movers: Movers, times: Float[Tensor, " F"]) -> None:
        """None yet.

        Args:
            movers: The parts and their motion.
            times: Of the pictures, in [0, 1].
        """
        super().__init__()
        device = times.device
        numbers = 6 if movers.stretches is None else 12
        self.values = torch.nn.Parameter(torch.zeros(*movers.shifts.shape[:2], numbers, device=device))
        self.middles = torch.from_numpy(movers.middles()).float().to(device)
        self.radii = _radii(movers).to(device)[:, None]
        self.pictures = movers.placed(times)
        self.before, share = movers.between(times)
        self.share = share.float()[:, None, None]

    def placed(self) -> Placed:
        """Where the parts are in the pictures; differentiable."""
        # index_select's gradient adds up in the same order each time; that of an index does not.
        before, after = (self.values.index_select(0, self.before + n) for n in (0, 1))
        values = torch.lerp(before, after, self.share)
        return self._corrected(self.pictures, values)

    @torch.no_grad()
    def applied(self, movers: Movers) -> Movers:
        """The movers with the corrections at their moments."""
        device, stretches = self.values.device, movers.stretches
        moments = Placed(movers.rotations.to(device), movers.shifts.to(device), movers.times.to(device))
        moments = moments._replace(stretches=stretches if stretches is None else stretches.to(device))
        placed = self._corrected(moments, self.values)
        stretches = None if placed.stretches is None else placed.stretches.cpu()
        return replace(
            movers, rotations=placed.rotations.cpu(), shifts=placed.shifts.cpu(), stretches=stretches
        )

    def _corrected(self, placed: Placed, values: Float[Tensor, "F M n"]) -> Placed:
        middles = torch.einsum("fmij,mj->fmi", placed.forth, self.middles) + placed.shifts
        turned = placed._replace(rotations=rotation(values[..., :3] / self.radii) @ placed.rotations)
        if placed.stretches is not None:
            turned = turned._replace(stretches=placed.stretches + symmetric(values[..., 6:] / self.radii))
        shifts = middles + values[..., 3:6] - torch.einsum("fmij,mj->fmi", turned.forth, self.middles)
        return turned._replace(shifts=shifts)


def rotation(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Matrices of rotation vectors (Rodrigues' formula); differentiable, at 0 too."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*vector.shape, 3)
    square = vector.square().sum(-1)[..., None, None]
    turns = square > 0
    # The root's slope at 0 is infinite: it is taken elsewhere.
    angle = torch.where(turns, torch.where(turns, square, 1.0).sqrt(), 0.0)
    once, twice = torch.sinc(angle / math.pi), 0.5 * torch.sinc(angle / (2 * math.pi)) ** 2
    return torch.eye(3, device=vector.device) + once * cross + twice * cross @ cross


def _radii(movers: Movers) -> Float[Tensor, " M"]:
    """Root mean square distance of each part's voxels from its middle, at least a voxel."""
    places, labels = vertices(movers.canonical.aabb, movers.canonical.shape), movers.labels.cpu()
    out = torch.full((movers.parts,), movers.canonical.voxel)
    for m, middle in enumerate(torch.from_numpy(movers.middles()).float()):
        own = places[labels == m + 1]
        if len(own):
            out[m] = out[m].clamp_min((own - middle).square().sum(1).mean().sqrt())
    return out
