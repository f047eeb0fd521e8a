"""What moves, apart from what stands: parts of the scene at rest, each with its own motion.

sigma(x, t) = sigma_stands(x) + sum over parts of sigma_part(x taken back by the part's motion). A ray is turned into
each part's own frame and marched there; all samples are then sorted along the ray and composited once, so nothing
blends across parts. Where two parts meet, both hold the voxels next to the border: a joint has no seam. A rigid part
turns and goes; a soft one stretches, too. How rays see all of it is in `rendering/layered.py`.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial.transform import Rotation
from torch import Tensor

from devrf.reconstruct.fields.canonical import EMPTY, Canonical
from devrf.reconstruct.fields.grids import grown, vertices
from devrf.reconstruct.fields.shading import Shading
from devrf.reconstruct.kernels.layers import PackedVolumes, Turned
from devrf.reconstruct.kernels.march import Volume
from devrf.reconstruct.kernels.occupancy import REACH, distance

# Rows and columns of the six entries that tell a symmetric matrix.
UPPER = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)


class Placed(NamedTuple):
    """Where parts are in some pictures.

    Attributes:
        rotations, shifts: A point x of part m at rest is at R S x + t in picture f.
        times: Of the pictures, in [0, 1].
        stretches: S, symmetric; None: the identity, all parts are rigid.
    """

    rotations: Float[Tensor, "F M 3 3"]
    shifts: Float[Tensor, "F M 3"]
    times: Float[Tensor, " F"]
    stretches: Float[Tensor, "F M 3 3"] | None = None

    @property
    def forth(self) -> Float[Tensor, "F M 3 3"]:
        """R S: from rest."""
        return self.rotations if self.stretches is None else self.rotations @ self.stretches

    @property
    def back(self) -> Float[Tensor, "F M 3 3"]:
        """Its inverse: to rest."""
        if self.stretches is None:
            return self.rotations.mT
        inverses = torch.linalg.inv_ex(self.stretches)[0]  # not checked: a GPU would wait for that
        return inverses @ self.rotations.mT

    def carried(self, x_rest: Float[Tensor, "n 3"], part: Int[Tensor, " n"]) -> Float[Tensor, "n 3"]:
        """Where resting points of parts are in the first picture; those of part 0 stand."""
        forth, t = self.forth[0, part - 1], self.shifts[0, part - 1]
        return torch.where((part > 0)[:, None], torch.einsum("nij,nj->ni", forth, x_rest) + t, x_rest)

    def turned(self, frame: Int[Tensor, " R"]) -> Turned:
        """How rays of these pictures are taken back to rest."""
        return Turned(self.back, self.forth, self.shifts, frame)


@dataclass
class Movers:
    """Parts and their motion.

    Attributes:
        canonical: Density and features of all parts at rest, empty elsewhere, on the grid of the scene at rest. Its MLP
            is that of what stands.
        labels: Part of each vertex, counted from 1; 0 stands.
        times: Moments of the motion, in the scene's time of [0, 1], rising and evenly spaced; on the CPU.
        rotations, shifts: At these moments, on the CPU: a point x at rest is at R S x + t.
        shading: How brightness changes; None: not at all.
        stretches: S of the parts at these moments, symmetric, the identity for rigid ones; on the CPU. None: all are.
    """

    canonical: Canonical
    labels: UInt8[Tensor, "X Y Z"]
    times: Float[Tensor, " T"]
    rotations: Float[Tensor, "T M 3 3"]
    shifts: Float[Tensor, "T M 3"]
    shading: Shading | None = None
    stretches: Float[Tensor, "T M 3 3"] | None = None
    _packed: PackedVolumes | None = field(default=None, repr=False)
    _middles: np.ndarray | None = field(default=None, repr=False)
    _distances: list[tuple[Tensor, Tensor]] | None = field(default=None, repr=False)

    @property
    def parts(self) -> int:
        """How many."""
        return self.rotations.shape[1]

    def stretched(self) -> Float[Tensor, "T M 3 3"]:
        """The stretches, also where all parts are rigid."""
        return torch.eye(3).expand_as(self.rotations) if self.stretches is None else self.stretches

    def unshaded(self) -> "Movers":
        """The same in constant light."""
        return replace(self, shading=None)

    def only(self, parts: Collection[int]) -> "Movers":
        """The same with some of the parts alone, which are counted from 1; all keep their numbers."""
        asked = torch.tensor(sorted(parts), dtype=torch.uint8, device=self.labels.device)
        kept = torch.isin(self.labels, asked)
        own, labels = self.canonical.only(kept), torch.where(kept, self.labels, 0)
        return Movers(own, labels, self.times, self.rotations, self.shifts, self.shading, self.stretches)

    def at_rest(self, time: Float[Tensor, "1"]) -> Placed:
        """Where nothing has moved, in the light of a time."""
        device = self.canonical.density.device
        turn = torch.eye(3, device=device).expand(1, self.parts, 3, 3)
        return Placed(turn, torch.zeros(1, self.parts, 3, device=device), time.to(device))

    def middles(self) -> Float[np.ndarray, "M 3"]:
        """Of the parts at rest."""
        if self._middles is None:
            labels = self.labels.cpu()
            places = vertices(self.canonical.aabb, self.canonical.shape)
            mine = [places[labels == m] for m in range(1, self.parts + 1)]
            self._middles = np.stack([p.mean(0).numpy() if len(p) else np.zeros(3) for p in mine])
        return self._middles

    def between(self, times: Float[Tensor, " F"]) -> tuple[Int[Tensor, " F"], Float[Tensor, " F"]]:
        """The moment before each time, which is never the last one, and how much of the way to the next is behind."""
        first, gap, last = float(self.times[0]), float(self.times[1] - self.times[0]), len(self.times) - 1
        at = ((times.double() - first) / gap).clamp(0, last)
        before = at.long().clamp(max=last - 1)
        return before, at - before

    def placed(self, times: Float[Tensor, " F"]) -> Placed:
        """Where the parts are at times, between the moments along arcs: their middles go straight, the rest turns."""
        device = self.canonical.density.device
        before, share = (x.cpu().numpy() for x in self.between(times))
        share = share[:, None]
        R, t, middles = self.rotations.double().numpy(), self.shifts.double().numpy(), self.middles()
        S = self.stretched().double().numpy()
        turn = R[before + 1] @ R[before].transpose(0, 1, 3, 2)
        turned = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(*turn.shape[:3])
        turned = Rotation.from_rotvec((share[..., None] * turned).reshape(-1, 3)).as_matrix()
        rotations = turned.reshape(turn.shape) @ R[before]
        place = np.einsum("tmij,mj->tmi", R @ S, middles) + t
        there = place[before] + share[..., None] * (place[before + 1] - place[before])
        stretches = S[before] + share[..., None, None] * (S[before + 1] - S[before])
        shifts = there - np.einsum("fmij,mj->fmi", rotations @ stretches, middles)
        return Placed(
            torch.from_numpy(rotations).float().to(device),
            torch.from_numpy(shifts).float().to(device),
            times.to(device),
            None if self.stretches is None else torch.from_numpy(stretches).float().to(device),
        )

    def distances(self) -> list[tuple[Int[Tensor, "3"], UInt8[Tensor, "A B C"]]]:
        """Of each part, the voxels to it around it, and the first vertex of where they are known."""
        if self._distances is None:
            self._distances = [_distance(self.labels == m + 1) for m in range(self.parts)]
        return self._distances

    def packed(self) -> PackedVolumes:
        """What the march needs to know of the parts: of each its own voxels and those next to them."""
        if self._packed is None:
            found = {m: _volume(self.canonical, self.labels == m) for m in range(1, self.parts + 1)}
            kept = {m: volume for m, volume in found.items() if volume is not None}
            self._packed = PackedVolumes.of(kept, self.labels.device)
        return self._packed

    def changed(self) -> None:
        """The density is another: `packed` is to be made anew."""
        self._packed = None


def symmetric(entries: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 3 3"]:
    """Symmetric matrices of their entries `UPPER`; differentiable."""
    xx, xy, xz, yy, yz, zz = entries.unbind(-1)
    return torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).unflatten(-1, (3, 3))


def _distance(own: Bool[Tensor, "X Y Z"]) -> tuple[Int[Tensor, "3"], UInt8[Tensor, "A B C"]]:
    """The first vertex of where the distance to some vertices is known, and these distances."""
    if not bool(own.any()):
        nowhere = torch.full((1, 1, 1), REACH, dtype=torch.uint8, device=own.device)
        return torch.zeros(3, dtype=torch.int64, device=own.device), nowhere
    lo, _, cut = _around(own, REACH)
    return lo, distance(own[cut].contiguous())


def _volume(canonical: Canonical, own: Bool[Tensor, "X Y Z"]) -> Volume | None:
    """What the march needs to know of a part of the vertices; None where it is empty."""
    if not bool(own.any()):
        return None
    lo, hi, cut = _around(own, 2)  # it grows by one, and another one around it is empty
    mine = grown(own[cut])
    density = torch.where(mine, canonical.density[cut][..., 0], EMPTY).contiguous()
    alpha = 1 - torch.exp(-canonical.interval * F.softplus(density + canonical.shift))
    occupied = grown(alpha > canonical.alpha_threshold) & mine
    low, high = canonical.aabb
    step = (high - low) / (torch.tensor(canonical.shape) - 1)
    box = low + torch.stack([lo, hi]).cpu() * step
    return replace(canonical.volume(), density=density, distance=distance(occupied), aabb=box)


def _around(own: Bool[Tensor, "X Y Z"], margin: int) -> tuple[Tensor, Tensor, tuple[slice, ...]]:
    """First and last vertex of the box of some vertices with a margin, and how it is cut out of a grid."""
    at = own.nonzero()
    last = torch.tensor(own.shape, device=own.device) - 1
    lo, hi = (at.amin(0) - margin).clamp(min=0), torch.minimum(at.amax(0) + margin, last)
    return lo, hi, tuple(slice(a, b + 1) for a, b in zip(lo.tolist(), hi.tolist(), strict=True))
