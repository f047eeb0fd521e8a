# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Find the samples along rays that matter: inside the box, in occupied space, visible and not transparent.

No gradient passes here: the march decides where to look, the renderer then looks again at the few places
found (a twentieth of all samples or less) and differentiates. Where the scene moves, a sample at x is looked
up at x + motion(x, time of its ray) in the scene at rest; a motion that leads out of the box leads to empty
space (the published program reads fog there) and is counted.
"""

from dataclasses import dataclass
from typing import NamedTuple, no_type_check

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, box_arguments, launch, use_warp
from devrf.reconstruct.kernels.quad import motion_at_time, quad_ref
from devrf.reconstruct.kernels.trilinear import cell_of, fraction_in, trilinear_ref

PARALLEL = 1e-9  # direction components below this are held to it, so that a slab test divides safely


class RaySegments(NamedTuple):
    """Parts of rays: origins and directions [R, 3], entry and exit [R], jitter in [0, 1) [R].

    Points are rays_o + t rays_d; directions are of unit length where t is to be a distance.
    """

    rays_o: Float[Tensor, "R 3"]
    rays_d: Float[Tensor, "R 3"]
    t_in: Float[Tensor, " R"]
    t_out: Float[Tensor, " R"]
    jitter: Float[Tensor, " R"]


def intersect(
    rays_o: Float[Tensor, "n 3"], rays_d: Float[Tensor, "n 3"], aabb: Float[Tensor, "2 3"], near: float
) -> tuple[Float[Tensor, " n"], Float[Tensor, " n"], Bool[Tensor, " n"]]:
    """Where rays enter and leave a box, not before `near`; both `near` where they miss it (third result false)."""
    aabb = aabb.to(rays_o)
    safe = torch.where(rays_d.abs() < PARALLEL, PARALLEL, rays_d)
    a, b = (aabb[0] - rays_o) / safe, (aabb[1] - rays_o) / safe
    t_in = torch.minimum(a, b).amax(-1).clamp(min=near)
    t_out = torch.maximum(a, b).amin(-1)
    hit = t_out > t_in
    return torch.where(hit, t_in, near), torch.where(hit, t_out, near), hit


@dataclass(frozen=True)
class Volume:
    """What is marched through: the scene at rest.

    Attributes:
        density: Raw density at vertices.
        distance: Vertices to the nearest occupied vertex (occupancy.py), of the same shape.
        aabb: Corners [2, 3], on the CPU.
        shift: Added to the raw density before the softplus.
        interval: Step length in base voxels, the exponent of Eq. 3 of DirectVoxGO.
        step: Step length, in the units of `aabb`.
        alpha_threshold, weight_threshold: Samples at or below are dropped.
    """

    density: Float[Tensor, "X Y Z"]
    distance: UInt8[Tensor, "X Y Z"]
    aabb: Float[Tensor, "2 3"]
    shift: float
    interval: float
    step: float
    alpha_threshold: float
    weight_threshold: float


@dataclass(frozen=True)
class Warp:
    """How the scene has moved.

    Attributes:
        field: Backward motion at key times.
        tau: Time of each ray, in key spacings.
        aabb: Corners of the motion's box [2, 3], on the CPU.
        distance: Vertices to the nearest place that may be occupied at these times, over `aabb`.
    """

    field: Float[Tensor, "T X Y Z 3"]
    tau: Float[Tensor, " R"]
    aabb: Float[Tensor, "2 3"]
    distance: UInt8[Tensor, "D E F"]


class Samples(NamedTuple):
    """Packed samples, ray by ray and near to far.

    Attributes:
        ray_id: Ray of each sample [S].
        t: Distance along its ray [S].
        offsets: Where each ray's samples begin, and the end of the last [R + 1].
        left_box: Number of samples whose motion led out of the rest scene's box.
        seen: Number of samples whose motion was looked up.
    """

    ray_id: Int[Tensor, " S"]
    t: Float[Tensor, " S"]
    offsets: Int[Tensor, " rays_and_one"]
    left_box: Int[Tensor, ""]
    seen: Int[Tensor, ""]


STOP = 1e-3  # transmittance below which nothing behind is looked at (published value)


def march(rays: RaySegments, volume: Volume, warp: Warp | None = None) -> Samples:
    """Walk along rays and return the samples that count."""
    if not use_warp(volume.density.device):
        return march_ref(rays, volume, warp)
    device, R = volume.density.device, len(rays.t_in)
    box = volume.aabb if warp is None else warp.aabb
    most = int(torch.linalg.vector_norm(box[1] - box[0]).item() / volume.step) + 2
    ts = torch.empty(R, most, device=device)
    counts = torch.zeros(R, 3, dtype=torch.int32, device=device)
    lo, scale = box_arguments(volume.aabb, tuple(volume.density.shape))
    shared = [
        *(array(rays.rays_o.contiguous(), wp.vec3), array(rays.rays_d.contiguous(), wp.vec3)),
        *(array(rays.t_in), array(rays.t_out), array(rays.jitter)),
        *(array(volume.density), array(volume.distance), wp.vec3(*lo), wp.vec3(*scale)),
        *(volume.shift, volume.interval, volume.step, volume.alpha_threshold, volume.weight_threshold),
    ]
    if warp is None:
        launch(_march, R, [*shared, array(ts), array(counts)], device)
    else:
        w_lo, w_scale = box_arguments(warp.aabb, warp.field.shape[1:4])
        _, live_scale = box_arguments(warp.aabb, tuple(warp.distance.shape))
        moving = [
            *(array(warp.field, wp.vec3), array(warp.tau), wp.vec3(*w_lo), wp.vec3(*w_scale)),
            *(array(warp.distance), wp.vec3(*live_scale)),
        ]
        launch(_march_moved, R, [*shared, *moving, array(ts), array(counts)], device)
    return _packed(ts, counts)


def march_ref(rays: RaySegments, volume: Volume, warp: Warp | None = None) -> Samples:
    """The same on a dense table of rays and steps, without leaps."""
    box = volume.aabb if warp is None else warp.aabb
    most = int(torch.linalg.vector_norm(box[1] - box[0]).item() / volume.step) + 2
    t = (
        rays.t_in[:, None]
        + (torch.arange(most, device=rays.t_in.device) + rays.jitter[:, None]) * volume.step
    )
    x = rays.rays_o[:, None] + t[..., None] * rays.rays_d[:, None]
    valid = t < rays.t_out[:, None]
    left_box = seen = torch.zeros_like(valid)
    flat = x.reshape(-1, 3)
    if warp is not None:
        valid = valid & _near(flat, warp.distance, warp.aabb).reshape(valid.shape)
        tau = warp.tau[:, None].expand(valid.shape).reshape(-1)
        flat = flat + quad_ref(warp.field, flat, tau.contiguous(), warp.aabb)
        lo, hi = volume.aabb.to(flat)
        inside = ((flat >= lo) & (flat <= hi)).all(-1).reshape(valid.shape)
        left_box, seen = valid & ~inside, valid
        valid = valid & inside
    valid = valid & _near(flat, volume.distance, volume.aabb).reshape(valid.shape)
    raw = trilinear_ref(volume.density[..., None], flat, volume.aabb).reshape(valid.shape)
    alpha = 1 - torch.exp(-volume.interval * F.softplus(raw + volume.shift))
    alpha = torch.where(valid & (alpha > volume.alpha_threshold), alpha, 0.0)
    trans = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha], dim=1), dim=1)[:, :-1]
    keep = (alpha > 0) & (alpha * trans > volume.weight_threshold) & (trans >= STOP)
    passed = trans >= STOP
    counts = torch.stack([keep.sum(1), (left_box & passed).sum(1), (seen & passed).sum(1)], dim=1).int()
    order = torch.argsort((~keep).int(), dim=1, stable=True)
    return _packed(torch.gather(t, 1, order), counts)


def _near(points: Tensor, distance: Tensor, aabb: Tensor) -> Tensor:
    last = torch.tensor(distance.shape, device=points.device) - 1
    lo, hi = aabb.to(points)
    vertex = ((points - lo) / (hi - lo) * last + 0.5).floor().long()
    held = vertex.clamp(min=torch.zeros_like(last), max=last)
    return distance[tuple(held.unbind(-1))] == 0


def _packed(ts: Tensor, counts: Tensor) -> Samples:
    """Close the gaps of a table [R, K] whose row r holds counts[r, 0] entries."""
    rays, most = ts.shape
    n = counts[:, 0].long()
    offsets = torch.zeros(rays + 1, dtype=torch.int64, device=ts.device)
    torch.cumsum(n, 0, out=offsets[1:])
    ray_id = torch.repeat_interleave(torch.arange(rays, device=ts.device), n)
    column = torch.arange(len(ray_id), device=ts.device) - offsets[ray_id]
    t = ts.reshape(-1)[ray_id * most + column]
    return Samples(ray_id, t, offsets, counts[:, 1].sum(), counts[:, 2].sum())


@wp.func
@no_type_check
def nearest(q: float, n: int) -> int:
    """Vertex nearest to an index coordinate."""
    return wp.clamp(int(wp.floor(q + 0.5)), 0, n - 1)


@wp.func
@no_type_check
def steps_away(distance: wp.array3d(dtype=wp.uint8), q: wp.vec3) -> int:
    """Vertices from the one nearest to index coordinates to what is occupied."""
    i = nearest(q[0], distance.shape[0])
    j = nearest(q[1], distance.shape[1])
    k = nearest(q[2], distance.shape[2])
    return int(distance[i, j, k])


@wp.func
@no_type_check
def scalar_at(grid: wp.array3d(dtype=float), q: wp.vec3) -> float:
    """Trilinear value at index coordinates."""
    i = cell_of(q[0], grid.shape[0])
    j = cell_of(q[1], grid.shape[1])
    k = cell_of(q[2], grid.shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    a = wp.lerp(
        wp.lerp(grid[i, j, k], grid[i, j, k + 1], z), wp.lerp(grid[i, j + 1, k], grid[i, j + 1, k + 1], z), y
    )
    b = wp.lerp(
        wp.lerp(grid[i + 1, j, k], grid[i + 1, j, k + 1], z),
        wp.lerp(grid[i + 1, j + 1, k], grid[i + 1, j + 1, k + 1], z),
        y,
    )
    return wp.lerp(a, b, x)


@wp.func
@no_type_check
def alpha_of(raw: float, interval: float) -> float:
    """1 - (1 + e^raw)^(-interval), without overflow."""
    softplus = wp.max(raw, 0.0) + wp.log(1.0 + wp.exp(-wp.abs(raw)))
    return 1.0 - wp.exp(-interval * softplus)


@wp.kernel(enable_backward=False)
@no_type_check
def _march(
    first: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=float),
    t_out: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    density: wp.array3d(dtype=float),
    distance: wp.array3d(dtype=wp.uint8),
    lo: wp.vec3,
    scale: wp.vec3,
    shift: float,
    interval: float,
    step: float,
    alpha_threshold: float,
    weight_threshold: float,
    ts: wp.array2d(dtype=float),
    counts: wp.array2d(dtype=wp.int32),
):
    r = first + wp.tid()
    origin = wp.cw_mul(rays_o[r] - lo, scale)
    direction = wp.cw_mul(rays_d[r], scale)
    leap = 1.0 / (step * wp.max(wp.max(wp.abs(direction[0]), wp.abs(direction[1])), wp.abs(direction[2])))
    trans = float(1.0)
    n = int(0)
    i = int(0)
    begin = t_in[r]
    end = t_out[r]
    t = begin + jitter[r] * step
    while t < end:
        q = origin + direction * t
        away = steps_away(distance, q)
        if away > 0:
            i += 1 + int(float(away - 1) * leap)
        else:
            i += 1
            alpha = alpha_of(scalar_at(density, q) + shift, interval)
            if alpha > alpha_threshold:
                if trans * alpha > weight_threshold:
                    ts[r, n] = t
                    n += 1
                trans *= 1.0 - alpha
                if trans < STOP:
                    break
        t = begin + (float(i) + jitter[r]) * step
    counts[r, 0] = n


@wp.kernel(enable_backward=False)
@no_type_check
def _march_moved(
    first: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=float),
    t_out: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    density: wp.array3d(dtype=float),
    distance: wp.array3d(dtype=wp.uint8),
    lo: wp.vec3,
    scale: wp.vec3,
    shift: float,
    interval: float,
    step: float,
    alpha_threshold: float,
    weight_threshold: float,
    field: wp.array4d(dtype=wp.vec3),
    tau: wp.array(dtype=float),
    field_lo: wp.vec3,
    field_scale: wp.vec3,
    live: wp.array3d(dtype=wp.uint8),
    live_scale: wp.vec3,
    ts: wp.array2d(dtype=float),
    counts: wp.array2d(dtype=wp.int32),
):
    r = first + wp.tid()
    pace = wp.cw_mul(rays_d[r], live_scale)
    leap = 1.0 / (step * wp.max(wp.max(wp.abs(pace[0]), wp.abs(pace[1])), wp.abs(pace[2])))
    trans = float(1.0)
    n = int(0)
    i = int(0)
    left = int(0)
    seen = int(0)
    begin = t_in[r]
    end = t_out[r]
    t = begin + jitter[r] * step
    while t < end:
        x = rays_o[r] + rays_d[r] * t
        away = steps_away(live, wp.cw_mul(x - field_lo, live_scale))
        if away > 0:
            i += 1 + int(float(away - 1) * leap)
        else:
            i += 1
            seen += 1
            q = wp.cw_mul(x + motion_at_time(field, tau[r], wp.cw_mul(x - field_lo, field_scale)) - lo, scale)
            if (
                q[0] < 0.0
                or q[1] < 0.0
                or q[2] < 0.0
                or q[0] > float(density.shape[0] - 1)
                or q[1] > float(density.shape[1] - 1)
                or q[2] > float(density.shape[2] - 1)
            ):
                left += 1
            elif steps_away(distance, q) == 0:
                alpha = alpha_of(scalar_at(density, q) + shift, interval)
                if alpha > alpha_threshold:
                    if trans * alpha > weight_threshold:
                        ts[r, n] = t
                        n += 1
                    trans *= 1.0 - alpha
                    if trans < STOP:
                        break
        t = begin + (float(i) + jitter[r]) * step
    counts[r, 0] = n
    counts[r, 1] = left
    counts[r, 2] = seen
