# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""March rays through what stands and all parts that move in one launch.

A ray is taken back into each volume's own frame, marched there as march.py does it, and what is found is kept in order
along the ray: samples near to far, whichever volume they are of. A part costs a ray only where the ray meets its box.
`march_layers` hands the samples on, one by one; `composite_layers.py` goes on to sums over each ray.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, no_type_check

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from devrf.reconstruct.kernels.launch import ODD, array, box_arguments, launch, use_warp
from devrf.reconstruct.kernels.march import STOP, RaySegments, Volume, alpha_of, intersect, march, nearest
from devrf.reconstruct.kernels.trilinear import cell_of, fraction_in

FARTHEST = 1e4  # box units: farther than any sample
MOST = 256  # samples of a ray that are kept, the nearest: an opaque surface takes about five, rays along one up to 120
LEAST_SPEED = wp.constant(1e-9)  # components of a direction below this are held to it
vec5 = wp.types.vector(length=5, dtype=wp.float32)


class Turned(NamedTuple):
    """How rays are taken back to where parts rest.

    Attributes:
        back, forth, shifts: Of picture f and part m, counted from 0: x at rest is back (x - shift), and x is forth x at
            rest + shift.
        frame: Picture of each ray.
    """

    back: Float[Tensor, "F M 3 3"]
    forth: Float[Tensor, "F M 3 3"]
    shifts: Float[Tensor, "F M 3"]
    frame: Int[Tensor, " R"]


@dataclass(frozen=True)
class PackedVolumes:
    """Volumes of parts one behind the other in memory, to be marched through in one launch.

    Attributes:
        volumes: The same by their numbers, which count from 1.
        density, distance: Of all their vertices.
        first: Where each begins.
        shapes: Vertices along x, y, z.
        boxes: Lower and upper corner, and the factor from a position to an index.
        rules: Shift, interval, step, least alpha and least weight (`Volume`).
        names: Number of each.
    """

    volumes: Mapping[int, Volume]
    density: Float[Tensor, " n"]
    distance: UInt8[Tensor, " n"]
    first: Int[Tensor, " V"]
    shapes: Int[Tensor, "V 3"]
    boxes: Float[Tensor, "V 3 3"]
    rules: Float[Tensor, "V 5"]
    names: Int[Tensor, " V"]

    @staticmethod
    def of(volumes: Mapping[int, Volume], device: torch.device) -> "PackedVolumes":
        """Copy volumes together."""
        kept = list(volumes.values())
        shapes = [tuple(v.density.shape) for v in kept]
        begins = [sum(math.prod(shape) for shape in shapes[:n]) for n in range(len(kept))]

        def sent(values: list[Any], kind: torch.dtype, *shape: int) -> Tensor:
            return torch.tensor(values, dtype=kind).reshape(-1, *shape).to(device)

        return PackedVolumes(
            volumes,
            torch.cat([torch.zeros(0, device=device), *(v.density.reshape(-1) for v in kept)]),
            torch.cat(
                [torch.zeros(0, dtype=torch.uint8, device=device), *(v.distance.reshape(-1) for v in kept)]
            ),
            sent(begins, torch.int32),
            sent(shapes, torch.int32, 3),
            sent([corners_and_scale(v) for v in kept], torch.float32, 3, 3),
            sent([rules_of(v) for v in kept], torch.float32, 5),
            sent(list(volumes), torch.int32),
        )

    def spheres(self, turned: Turned) -> Float[Tensor, "F V 4"]:
        """Middle and radius of a sphere around each volume, where it is in each picture."""
        index = (self.names - 1).long()
        forth, shifts = turned.forth[:, index], turned.shifts[:, index]
        lo, hi = self.boxes[:, 0], self.boxes[:, 1]
        corners = torch.stack([torch.stack(xyz, -1) for xyz in product(*zip(lo.T, hi.T, strict=True))], 1)
        middle = torch.einsum("fvij,vj->fvi", forth, (lo + hi) / 2) + shifts
        away = torch.einsum("fvij,vcj->fvci", forth, corners - ((lo + hi) / 2)[:, None]).norm(dim=-1)
        return torch.cat([middle, away.amax(-1, keepdim=True)], dim=-1)


def corners_and_scale(volume: Volume) -> list[list[float]]:
    """Lower and upper corner of a volume, and the factor from a position to an index."""
    x, y, z = volume.density.shape
    return [*volume.aabb.tolist(), box_arguments(volume.aabb, (x, y, z))[1]]


def rules_of(volume: Volume) -> tuple[float, ...]:
    """Numbers by which samples of a volume are found."""
    v = volume
    return v.shift, v.interval, v.step, v.alpha_threshold, v.weight_threshold


class LayerSamples(NamedTuple):
    """Samples of all volumes, ray by ray and near to far.

    Attributes:
        ray_id: Ray of each.
        t: Distance along it.
        part: Whose it is; 0 stands.
        x: Where it rests.
        towards: Direction of its ray there, of unit length.
        offsets: Where each ray's samples begin, and the end of the last.
    """

    ray_id: Int[Tensor, " S"]
    t: Float[Tensor, " S"]
    part: Int[Tensor, " S"]
    x: Float[Tensor, "S 3"]
    towards: Float[Tensor, "S 3"]
    offsets: Int[Tensor, " rays_and_one"]


@torch.no_grad()
def march_layers(
    stands: Volume,
    parts: PackedVolumes,
    turned: Turned,
    rays_o: Float[Tensor, "R 3"],
    rays_d: Float[Tensor, "R 3"],
    near: float,
    jitter: Float[Tensor, " R"],
) -> LayerSamples:
    """Samples that count, of what stands and of parts.

    Args:
        stands: What stands.
        parts: What moves.
        turned: Where it is.
        rays_o, rays_d: In the frame of what stands.
        near: Distance before which rays do not begin.
        jitter: Of the first step, in steps.
    """
    if not use_warp(rays_o.device):
        return march_layers_ref(stands, parts, turned, rays_o, rays_d, near, jitter)
    R, device = len(rays_o), rays_o.device
    sampled = marched(stands, parts, turned, rays_o, rays_d, near, jitter)
    offsets = torch.zeros(R + 1, dtype=torch.int64, device=device)
    torch.cumsum(sampled.counts, 0, out=offsets[1:])
    S = int(offsets[-1])
    ray_id, part = (torch.empty(S, dtype=torch.int64, device=device) for _ in range(2))
    t, x, towards = (torch.empty(S, *shape, device=device) for shape in ((), (3,), (3,)))
    outputs = [array(ray_id), array(t), array(part), array(x, wp.vec3), array(towards, wp.vec3)]
    launch(_pack, R, [*sampled.rays, *sampled.table[:2], array(offsets), *outputs], device)
    return LayerSamples(ray_id, t, part, x, towards, offsets)


@torch.no_grad()
def march_layers_ref(
    stands: Volume,
    parts: PackedVolumes,
    turned: Turned,
    rays_o: Tensor,
    rays_d: Tensor,
    near: float,
    jitter: Tensor,
) -> LayerSamples:
    """The same, volume by volume; all samples are kept."""
    found = [(0, stands, rays_o, rays_d)]
    for name, volume in parts.volumes.items():
        mine = turned.back[turned.frame, name - 1]
        o = torch.einsum("rij,rj->ri", mine, rays_o - turned.shifts[turned.frame, name - 1])
        found.append((name, volume, o, torch.einsum("rij,rj->ri", mine, rays_d)))
    out: list[tuple[Tensor, ...]] = []
    for name, volume, o, d in found:
        t_in, t_out, _ = intersect(o, d, volume.aabb, near)
        samples = march(RaySegments(o, d, t_in, t_out, jitter), volume)
        ray_id, towards = samples.ray_id.long(), F.normalize(d, dim=1)
        x = o[ray_id] + samples.t[:, None] * d[ray_id]
        out.append((ray_id, samples.t, torch.full_like(ray_id, name), x, towards[ray_id]))
    ray_id, t, part, x, towards = (torch.cat(values) for values in zip(*out, strict=True))
    order = torch.argsort(ray_id.double() * FARTHEST + t.double(), stable=True)
    offsets = torch.zeros(len(rays_o) + 1, dtype=torch.int64, device=x.device)
    torch.cumsum(torch.bincount(ray_id, minlength=len(rays_o)), 0, out=offsets[1:])
    return LayerSamples(ray_id[order], t[order], part[order], x[order], towards[order], offsets)


class Marched(NamedTuple):
    """Arguments of kernels that follow the march: of rays and their pictures; what was found, its counts and size."""

    rays: list[Any]
    table: list[Any]
    counts: Tensor
    size: tuple[int, int]


@torch.no_grad()
def marched(
    stands: Volume,
    parts: PackedVolumes,
    turned: Turned,
    rays_o: Tensor,
    rays_d: Tensor,
    near: float,
    jitter: Tensor,
) -> Marched:
    """Distances and parts of the samples of each ray, sample by sample: what is not needed is never touched."""
    R, device = len(rays_o), rays_o.device
    ts, found = (torch.empty(MOST, R + ODD, dtype=k, device=device) for k in (torch.float32, torch.int32))
    counts = torch.empty(R, dtype=torch.int32, device=device)
    o, d = array(rays_o.contiguous(), wp.vec3), array(rays_d.contiguous(), wp.vec3)
    frame, shifts = array(turned.frame), array(turned.shifts.contiguous(), wp.vec3)
    back, table = array(turned.back.contiguous(), wp.mat33), [array(ts), array(found), array(counts)]
    arguments = [
        *(o, d, array(jitter.contiguous()), frame, back, shifts, near),
        *(
            array(stands.density.reshape(-1)),
            array(stands.distance.reshape(-1)),
            wp.vec3i(*stands.density.shape),
        ),
        *(*(wp.vec3(*corner) for corner in corners_and_scale(stands)), vec5(*rules_of(stands))),
        *(array(parts.density), array(parts.distance), array(parts.first), array(parts.shapes, wp.vec3i)),
        *(array(parts.boxes, wp.vec3), array(parts.rules, vec5), array(parts.names)),
        *(array(parts.spheres(turned).contiguous(), wp.vec4), *table),
    ]
    launch(_march, R, arguments, device)
    return Marched([o, d, frame, back, shifts], table, counts, (MOST, R + ODD))


@wp.func
@no_type_check
def density_at(density: wp.array(dtype=float), first: int, shape: wp.vec3i, q: wp.vec3) -> float:
    """Trilinear value at index coordinates of a volume that begins at `first`."""
    i = cell_of(q[0], shape[0])
    j = cell_of(q[1], shape[1])
    k = cell_of(q[2], shape[2])
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    row = shape[2]
    at = first + (i * shape[1] + j) * row + k
    a = wp.lerp(
        wp.lerp(density[at], density[at + 1], z), wp.lerp(density[at + row], density[at + row + 1], z), y
    )
    at += shape[1] * row
    b = wp.lerp(
        wp.lerp(density[at], density[at + 1], z), wp.lerp(density[at + row], density[at + row + 1], z), y
    )
    return wp.lerp(a, b, fraction_in(q[0], i))


@wp.func
@no_type_check
def held(x: float) -> float:
    """Held away from 0, so that a slab test divides safely."""
    return wp.where(wp.abs(x) < LEAST_SPEED, LEAST_SPEED, x)


@wp.func
@no_type_check
def kept(
    r: int, n: int, t: float, part: int, ts: wp.array2d(dtype=float), found: wp.array2d(dtype=wp.int32)
) -> int:
    """Put a sample where it belongs among the n of a ray; returns how many there are then."""
    last = n
    if n == ts.shape[0]:
        if t >= ts[n - 1, r]:
            return n
        last = n - 1
    s = int(last)
    while s > 0:
        if ts[s - 1, r] <= t:
            break
        ts[s, r] = ts[s - 1, r]
        found[s, r] = found[s - 1, r]
        s -= 1
    ts[s, r] = t
    found[s, r] = part
    return last + 1


@wp.func
@no_type_check
def through(
    r: int,
    n: int,
    o: wp.vec3,
    d: wp.vec3,
    near: float,
    jitter: float,
    density: wp.array(dtype=float),
    distance: wp.array(dtype=wp.uint8),
    first: int,
    shape: wp.vec3i,
    lo: wp.vec3,
    hi: wp.vec3,
    scale: wp.vec3,
    rules: vec5,
    part: int,
    ts: wp.array2d(dtype=float),
    found: wp.array2d(dtype=wp.int32),
) -> int:
    """March through one volume; returns how many samples the ray has then."""
    ax = (lo[0] - o[0]) / held(d[0])
    bx = (hi[0] - o[0]) / held(d[0])
    ay = (lo[1] - o[1]) / held(d[1])
    by = (hi[1] - o[1]) / held(d[1])
    az = (lo[2] - o[2]) / held(d[2])
    bz = (hi[2] - o[2]) / held(d[2])
    begin = wp.max(wp.max(wp.max(wp.min(ax, bx), wp.min(ay, by)), wp.min(az, bz)), near)
    end = wp.min(wp.min(wp.max(ax, bx), wp.max(ay, by)), wp.max(az, bz))
    if end <= begin:
        return n
    origin = wp.cw_mul(o - lo, scale)
    direction = wp.cw_mul(d, scale)
    step = rules[2]
    leap = 1.0 / (step * wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2])))
    trans = float(1.0)
    count = int(n)
    i = int(0)
    t = begin + jitter * step
    while t < end:
        q = origin + direction * t
        x = nearest(q[0], shape[0])
        y = nearest(q[1], shape[1])
        z = nearest(q[2], shape[2])
        away = int(distance[first + (x * shape[1] + y) * shape[2] + z])
        if away > 0:
            i += 1 + int(float(away - 1) * leap)
        else:
            i += 1
            alpha = alpha_of(density_at(density, first, shape, q) + rules[0], rules[1])
            if alpha > rules[3]:
                if trans * alpha > rules[4]:
                    count = kept(r, count, t, part, ts, found)
                trans *= 1.0 - alpha
                if trans < STOP:
                    break
        t = begin + (float(i) + jitter) * step
    return count


@wp.kernel(enable_backward=False)
@no_type_check
def _march(
    start: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    jitter: wp.array(dtype=float),
    frame: wp.array(dtype=wp.int64),
    back: wp.array2d(dtype=wp.mat33),
    shifts: wp.array2d(dtype=wp.vec3),
    near: float,
    density: wp.array(dtype=float),
    distance: wp.array(dtype=wp.uint8),
    shape: wp.vec3i,
    lo: wp.vec3,
    hi: wp.vec3,
    scale: wp.vec3,
    rules: vec5,
    own_density: wp.array(dtype=float),
    own_distance: wp.array(dtype=wp.uint8),
    firsts: wp.array(dtype=wp.int32),
    shapes: wp.array(dtype=wp.vec3i),
    boxes: wp.array2d(dtype=wp.vec3),
    own_rules: wp.array(dtype=vec5),
    names: wp.array(dtype=wp.int32),
    spheres: wp.array2d(dtype=wp.vec4),
    ts: wp.array2d(dtype=float),
    found: wp.array2d(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    r = start + wp.tid()
    o = rays_o[r]
    d = rays_d[r]
    n = through(
        r, 0, o, d, near, jitter[r], density, distance, 0, shape, lo, hi, scale, rules, 0, ts, found,
    )  # fmt: skip
    f = int(frame[r])
    for v in range(names.shape[0]):
        sphere = spheres[f, v]
        aside = wp.cross(wp.vec3(sphere[0], sphere[1], sphere[2]) - o, d)
        if wp.length_sq(aside) <= sphere[3] * sphere[3] * wp.length_sq(d):
            m = names[v] - 1
            n = through(
                r, n, back[f, m] * (o - shifts[f, m]), back[f, m] * d, near, jitter[r], own_density, own_distance,
                firsts[v], shapes[v], boxes[v, 0], boxes[v, 1], boxes[v, 2], own_rules[v], m + 1, ts, found,
            )  # fmt: skip
    counts[r] = n


@wp.kernel(enable_backward=False)
@no_type_check
def _pack(
    start: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    frame: wp.array(dtype=wp.int64),
    back: wp.array2d(dtype=wp.mat33),
    shifts: wp.array2d(dtype=wp.vec3),
    ts: wp.array2d(dtype=float),
    found: wp.array2d(dtype=wp.int32),
    offsets: wp.array(dtype=wp.int64),
    ray_id: wp.array(dtype=wp.int64),
    t: wp.array(dtype=float),
    part: wp.array(dtype=wp.int64),
    x: wp.array(dtype=wp.vec3),
    towards: wp.array(dtype=wp.vec3),
):
    r = start + wp.tid()
    begin = int(offsets[r])
    for n in range(int(offsets[r + 1]) - begin):
        s = begin + n
        place = rays_o[r] + rays_d[r] * ts[n, r]
        d = rays_d[r]
        m = found[n, r] - 1
        if m >= 0:
            f = int(frame[r])
            place = back[f, m] * (place - shifts[f, m])
            d = wp.normalize(back[f, m] * d)
        ray_id[s] = wp.int64(r)
        t[s] = ts[n, r]
        part[s] = wp.int64(m + 1)
        x[s] = place
        towards[s] = d
