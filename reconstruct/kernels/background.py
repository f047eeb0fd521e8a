# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Render the static surroundings of the box in one pass; where a gradient is wanted, samples that count are kept.

The surroundings are one grid over space contracted to [-2, 2]^3: u is the position in half sizes of the box
from its centre, r = max |u|, and y = u inside the box, (1 + log r / log reach) u / r outside, at most 2. Like
mip-NeRF 360's (2 - 1/r) u / r (Barron et al. 2022, Eq. 10; here with the largest component in place of the
length) it shrinks space with distance, but in step with a pixel's footprint, as 1/r: a room's walls, three or
four half sizes away, keep twice the resolution in depth. Where little lies far behind the rest, as a garden behind a
window, log r is bent: most of the depth is spent on what is near. What is farther than the reach lies on the cube's
faces, where rays end. The grid holds raw density and raw colour; steps grow with r. The forward pass keeps the
distance, raw density and colour of each sample that counts; the backward pass only scatters: what lies behind sample i
is the final colour minus what has been passed.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Float, UInt8
from torch import Tensor

from devrf.reconstruct.kernels.launch import ODD, array, launch, use_warp
from devrf.reconstruct.kernels.march import STOP, RaySegments, alpha_of, nearest, steps_away
from devrf.reconstruct.kernels.trilinear import gathered_in, look_up, scatter, trilinear_ref

NEAR_SHARE = 0.85  # of the cube's depth outside the box, for what is nearer than the bend
PARALLEL = 1e-9  # speeds along an axis below this are held to it: the ray leaves the cube by another face
LEAST_SPEED = wp.constant(PARALLEL)
vec4 = wp.types.vector(length=4, dtype=wp.float32)


@dataclass(frozen=True)
class Contraction:
    """How space around the box is contracted.

    Attributes:
        reach: Half sizes of the box that the cube holds.
        bend: Half sizes up to which space gets `NEAR_SHARE` of the cube's depth, if it would get less; 1: it does not.
    """

    reach: float
    bend: float = 1.0

    @property
    def slopes(self) -> tuple[float, float, float]:
        """Depth in the cube per logarithm of the radius, up to a logarithm, and beyond."""
        whole, bend = math.log(self.reach), math.log(self.bend)
        if not 0 < bend < NEAR_SHARE * whole:
            return 1 / whole, whole, 0.0
        return NEAR_SHARE / bend, bend, (1 - NEAR_SHARE) / (whole - bend)


@dataclass(frozen=True)
class Surroundings:
    """What lies around the box.

    Attributes:
        grid: Raw density and raw red, green, blue at vertices of the contracted cube.
        distance: Vertices to the nearest occupied vertex (occupancy.py); samples elsewhere are skipped.
        aabb: The box in the middle [2, 3], on the CPU.
        shift: Added to the raw density before the softplus.
        interval: Step length in base voxels.
        step: Step length in contracted units at the box's surface.
        alpha_threshold: Samples at or below are dropped.
        contraction: Of space to the cube.
    """

    grid: Float[Tensor, "X Y Z 4"]
    distance: UInt8[Tensor, "X Y Z"]
    aabb: Float[Tensor, "2 3"]
    shift: float
    interval: float
    step: float
    alpha_threshold: float
    contraction: Contraction


def background(
    rays: RaySegments,
    surroundings: Surroundings,
    closed: bool,
    target: Float[Tensor, "R 3"] | None = None,
    grid_grad: Float[Tensor, "P X Y Z 4"] | None = None,
    seen: Float[Tensor, "X Y Z"] | None = None,
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, " R"]]:
    """Render the surroundings along ray segments; differentiable in the grid.

    Args:
        rays: Segments that do not enter the box.
        surroundings: What to render.
        closed: Segments end where they leave the cube instead: what is left takes the colour of its face there.
        target: True colours, for the third result.
        grid_grad: Where given, the grid's gradient is added here instead of being returned to autograd: to one
            copy or, in parts, to `copies_for(device)` of them.
        seen: Where given, raised to the largest weight of a sample nearest to each vertex (Warp only).
    Returns:
        Colours [R, 3]; transmittance left [R] (0 where closed); per ray the sum of weight times squared
        distance of each sample's colour from `target` (0 without), whose gradient reaches the colours only.
    """
    if not use_warp(surroundings.grid.device):
        if grid_grad is not None:
            surroundings = replace(surroundings, grid=gathered_in(surroundings.grid, grid_grad[0]))
        return background_ref(rays, surroundings, closed, target)
    grid = surroundings.grid if grid_grad is None else surroundings.grid.detach().requires_grad_()
    wanted = target if target is not None else rays.rays_o
    kept = most_samples(surroundings) if torch.is_grad_enabled() and grid.requires_grad else 0
    return _Background.apply(
        grid, rays, surroundings, closed, wanted, target is not None, grid_grad, seen, kept
    )  # type: ignore[return-value]


def most_samples(surroundings: Surroundings) -> int:
    """Most samples of a ray that begins in the cube.

    A step covers step * r of the ray's length in half sizes of the box, and r is at least 1 and the distance from the
    middle over the root of 3: 2 roots of 3 inside the box, and the logarithm of the reach times as much on both sides.
    """
    step = surroundings.step
    return math.ceil(2 * math.sqrt(3) * (1 + math.log(surroundings.contraction.reach)) * (1 / step + 1)) + 2


def contract(u: Float[Tensor, "*n 3"], contraction: Contraction) -> Float[Tensor, "*n 3"]:
    """Contract positions in half sizes of the box to [-2, 2]^3."""
    near, bend, far = contraction.slopes
    r = u.abs().amax(-1, keepdim=True).clamp(min=1)
    away = torch.log(r)
    return (1 + near * away.clamp(max=bend) + far * (away - bend).clamp(min=0)).clamp(max=2) * u / r


def expand(y: Float[Tensor, "*n 3"], contraction: Contraction) -> Float[Tensor, "*n 3"]:
    """Undo `contract`."""
    near, bend, far = contraction.slopes
    s = y.abs().amax(-1, keepdim=True)
    depth = (s - 1).clamp(min=0)
    beyond = (depth - near * bend).clamp(min=0) / far if far else torch.zeros_like(depth)
    return torch.where(s > 1, y / s.clamp(min=1) * torch.exp((depth / near).clamp(max=bend) + beyond), y)


def background_ref(
    rays: RaySegments, surroundings: Surroundings, closed: bool, target: Float[Tensor, "R 3"] | None = None
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, " R"]]:
    """The same, all rays a step at a time."""
    lo, hi = surroundings.aabb.to(rays.rays_o)
    u0, du = (rays.rays_o - (lo + hi) / 2) * 2 / (hi - lo), rays.rays_d * 2 / (hi - lo)
    speed = torch.linalg.vector_norm(du, dim=-1)
    cube = torch.tensor([[-2.0] * 3, [2.0] * 3])
    r = (u0 + rays.t_in[:, None] * du).abs().amax(-1).clamp(min=1)
    t = rays.t_in + rays.jitter * surroundings.step * r / speed
    trans, rgb, per_point = torch.ones_like(t), torch.zeros_like(u0), torch.zeros_like(t)
    last = torch.tensor(surroundings.grid.shape[:3], device=t.device) - 1
    end = rays.t_out
    if closed:
        end = ((surroundings.contraction.reach - du.sign() * u0) / du.abs().clamp(min=PARALLEL)).amin(-1)
    while bool((t < end).any()):
        u = u0 + t[:, None] * du
        y = contract(u, surroundings.contraction)
        vertex = ((y + 2) / 4 * last + 0.5).floor().long().clamp(min=torch.zeros_like(last), max=last)
        away = surroundings.distance[tuple(vertex.unbind(-1))].float()
        valid = (t < end) & (away == 0) & (trans >= STOP)
        raw = trilinear_ref(surroundings.grid, y, cube)
        alpha = 1 - torch.exp(-surroundings.interval * F.softplus(raw[:, 0] + surroundings.shift))
        alpha = torch.where(valid & (alpha > surroundings.alpha_threshold), alpha, 0.0)
        weight, colour = trans * alpha, torch.sigmoid(raw[:, 1:])
        rgb = rgb + weight[:, None] * colour
        if target is not None:
            per_point = per_point + weight.detach() * ((colour - target) ** 2).sum(-1)
        trans = trans * (1 - alpha)
        room = (away - 1).clamp(min=0) * 4 / last.max()
        t = t + (room / (2 + room)).clamp(min=surroundings.step) * u.abs().amax(-1).clamp(min=1) / speed
    if closed:
        face = contract(u0 + torch.maximum(end, rays.t_in)[:, None] * du, surroundings.contraction)
        rgb = rgb + trans[:, None] * torch.sigmoid(trilinear_ref(surroundings.grid, face, cube)[:, 1:])
        trans = trans * 0
    return rgb, trans, per_point


class _Background(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        grid: Tensor,
        rays: RaySegments,
        surroundings: Surroundings,
        closed: bool,
        target: Tensor,
        has_target: bool,
        grid_grad: Tensor | None,
        seen: Tensor | None,
        kept: int,
    ) -> tuple[Tensor, Tensor, Tensor]:
        n, device = len(rays.t_in), grid.device
        shared = [
            *_arguments(rays, surroundings, closed, target, has_target),
            *(array(rays.t_out), array(rays.jitter), array(surroundings.distance)),
            *(surroundings.shift, surroundings.step, surroundings.alpha_threshold),
        ]
        rgb, left, per_point = (torch.empty(n, *shape, device=device) for shape in ((3,), (), ()))
        # Sample by sample: what lies behind the last one of any ray is never touched.
        ts, raws = torch.empty(kept, n + ODD, device=device), torch.empty(kept, n + ODD, 4, device=device)
        counts = torch.empty(n, dtype=torch.int32, device=device)
        samples = [array(ts), array(raws, vec4), array(counts)]
        outputs = [*samples, array(rgb, wp.vec3), array(left), array(per_point)]
        if seen is None:
            launch(_forward, n, [*shared, *outputs, 0, array(torch.zeros(1, 1, 1, device=device))], device)
        else:
            launch(_forward, n, [*shared, *outputs, 1], device, into=[array(seen)])
        ctx.save_for_backward(rgb, left)
        ctx.rest = rays, surroundings, closed, target, has_target, grid_grad, (ts, raws, counts)
        return rgb, left, per_point

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Any, ...]:
        rgb, left = ctx.saved_tensors
        rays, surroundings, closed, target, has_target, grid_grad, (ts, raws, counts) = ctx.rest
        out = grid_grad if grid_grad is not None else torch.zeros_like(surroundings.grid)[None]
        rgb_grad, left_grad, point_grad = (g.contiguous() for g in grad_outputs)
        arguments = [
            *_arguments(rays, surroundings, closed, target, has_target),
            *(array(ts), array(raws, vec4), array(counts)),
            *(array(rgb, wp.vec3), array(left)),
            *(array(rgb_grad, wp.vec3), array(left_grad), array(point_grad)),
        ]
        launch(_backward, len(left), arguments, out.device, into=[array(copy, vec4) for copy in out])
        return out[0] if grid_grad is None else None, *(None,) * 8


def _arguments(
    rays: RaySegments, surroundings: Surroundings, closed: bool, target: Tensor, has_target: bool
) -> list[Any]:
    """Of both passes."""
    lo, hi = surroundings.aabb.tolist()
    centre = [(a + b) / 2 for a, b in zip(lo, hi, strict=True)]
    per_half = [2 / (b - a) for a, b in zip(lo, hi, strict=True)]
    return [
        *(
            array(rays.rays_o.contiguous(), wp.vec3),
            array(rays.rays_d.contiguous(), wp.vec3),
            array(rays.t_in),
        ),
        *(array(surroundings.grid, vec4), wp.vec3(*centre), wp.vec3(*per_half)),
        *(surroundings.interval, surroundings.contraction.reach, wp.vec3(*surroundings.contraction.slopes)),
        *(int(closed), array(target.contiguous(), wp.vec3), int(has_target)),
    ]


@wp.func
@no_type_check
def radius_of(u: wp.vec3) -> float:
    return wp.max(1.0, wp.max(wp.max(wp.abs(u[0]), wp.abs(u[1])), wp.abs(u[2])))


@wp.func
@no_type_check
def exit_of(u0: wp.vec3, du: wp.vec3, reach: float) -> float:
    """Where a ray leaves the cube of this half size."""
    x = (reach - wp.sign(du[0]) * u0[0]) / wp.max(wp.abs(du[0]), LEAST_SPEED)
    y = (reach - wp.sign(du[1]) * u0[1]) / wp.max(wp.abs(du[1]), LEAST_SPEED)
    z = (reach - wp.sign(du[2]) * u0[2]) / wp.max(wp.abs(du[2]), LEAST_SPEED)
    return wp.min(wp.min(x, y), z)


@wp.func
@no_type_check
def leap(away: int, voxel: float) -> float:
    """How far all is empty, as a share of the radius, `away` vertices from what is occupied.

    The contraction stretches a way from radius r to r - d by 2 / (r - d) at most.
    """
    room = float(away - 1) * voxel
    return room / (2.0 + room)


@wp.func
@no_type_check
def sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


@wp.func
@no_type_check
def colour_of(v: vec4) -> wp.vec3:
    return wp.vec3(sigmoid(v[1]), sigmoid(v[2]), sigmoid(v[3]))


@wp.func
@no_type_check
def raw_colour_grad(grad: wp.vec3, colour: wp.vec3) -> vec4:
    """What a gradient of a colour is for raw values; that of the density is 0."""
    slope = wp.cw_mul(colour, wp.vec3(1.0, 1.0, 1.0) - colour)
    return vec4(0.0, grad[0] * slope[0], grad[1] * slope[1], grad[2] * slope[2])


@wp.func
@no_type_check
def index_of(u: wp.vec3, r: float, slopes: wp.vec3, grid: wp.array3d(dtype=vec4)) -> wp.vec3:
    """Index coordinates of a position given in half sizes of the box."""
    away = wp.log(r)
    depth = slopes[0] * wp.min(away, slopes[1]) + slopes[2] * wp.max(away - slopes[1], 0.0)
    y = u * (wp.min(1.0 + depth, 2.0) / r) + wp.vec3(2.0, 2.0, 2.0)
    return wp.vec3(
        y[0] * 0.25 * float(grid.shape[0] - 1),
        y[1] * 0.25 * float(grid.shape[1] - 1),
        y[2] * 0.25 * float(grid.shape[2] - 1),
    )


@wp.kernel(enable_backward=False)
@no_type_check
def _forward(
    first: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=float),
    grid: wp.array3d(dtype=vec4),
    centre: wp.vec3,
    per_half: wp.vec3,
    interval: float,
    reach: float,
    slopes: wp.vec3,
    closed: int,
    target: wp.array(dtype=wp.vec3),
    has_target: int,
    t_out: wp.array(dtype=float),
    jitter: wp.array(dtype=float),
    distance: wp.array3d(dtype=wp.uint8),
    shift: float,
    step: float,
    alpha_threshold: float,
    ts: wp.array2d(dtype=float),
    raws: wp.array2d(dtype=vec4),
    counts: wp.array(dtype=wp.int32),
    rgb: wp.array(dtype=wp.vec3),
    left: wp.array(dtype=float),
    per_point: wp.array(dtype=float),
    has_seen: int,
    seen: wp.array3d(dtype=float),
):
    n = first + wp.tid()
    u0 = wp.cw_mul(rays_o[n] - centre, per_half)
    du = wp.cw_mul(rays_d[n], per_half)
    stride = step / wp.length(du)
    voxel = 4.0 / float(wp.max(wp.max(grid.shape[0], grid.shape[1]), grid.shape[2]) - 1)
    end = t_out[n]
    if closed == 1:
        end = exit_of(u0, du, reach)
    t = t_in[n]
    t += jitter[n] * stride * radius_of(u0 + du * t)
    trans = float(1.0)
    total = wp.vec3(0.0, 0.0, 0.0)
    apart = float(0.0)
    most = ts.shape[0]
    kept = int(0)
    while t < end:
        u = u0 + du * t
        r = radius_of(u)
        q = index_of(u, r, slopes, grid)
        away = steps_away(distance, q)
        if away == 0:
            v = look_up(grid, q)
            alpha = alpha_of(v[0] + shift, interval)
            if alpha > alpha_threshold:
                c = colour_of(v)
                if most > 0:
                    if kept == most:
                        break  # a camera far outside of the cube
                    ts[kept, n] = t
                    raws[kept, n] = vec4(v[0] + shift, c[0], c[1], c[2])
                    kept += 1
                total += c * (trans * alpha)
                if has_seen == 1:
                    i = nearest(q[0], grid.shape[0])
                    j = nearest(q[1], grid.shape[1])
                    k = nearest(q[2], grid.shape[2])
                    wp.atomic_max(seen, i, j, k, trans * alpha)
                if has_target == 1:
                    apart += trans * alpha * wp.length_sq(c - target[n])
                trans *= 1.0 - alpha
                if trans < STOP:
                    break
        t += stride * r * wp.max(1.0, leap(away, voxel) / step)
    if closed == 1:
        far = u0 + du * wp.max(end, t_in[n])
        total += colour_of(look_up(grid, index_of(far, radius_of(far), slopes, grid))) * trans
        trans = 0.0
    counts[n] = kept
    rgb[n] = total
    left[n] = trans
    per_point[n] = apart


@wp.kernel(enable_backward=False)
@no_type_check
def _backward(
    first: int,
    rays_o: wp.array(dtype=wp.vec3),
    rays_d: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=float),
    grid: wp.array3d(dtype=vec4),
    centre: wp.vec3,
    per_half: wp.vec3,
    interval: float,
    reach: float,
    slopes: wp.vec3,
    closed: int,
    target: wp.array(dtype=wp.vec3),
    has_target: int,
    ts: wp.array2d(dtype=float),
    raws: wp.array2d(dtype=vec4),
    counts: wp.array(dtype=wp.int32),
    rgb: wp.array(dtype=wp.vec3),
    left: wp.array(dtype=float),
    rgb_grad: wp.array(dtype=wp.vec3),
    left_grad: wp.array(dtype=float),
    point_grad: wp.array(dtype=float),
    grid_grad: wp.array3d(dtype=vec4),
):
    n = first + wp.tid()
    u0 = wp.cw_mul(rays_o[n] - centre, per_half)
    du = wp.cw_mul(rays_d[n], per_half)
    g = rgb_grad[n]
    trans = float(1.0)
    behind = wp.dot(g, rgb[n]) + left_grad[n] * left[n]
    for m in range(counts[n]):
        u = u0 + du * ts[m, n]
        v = raws[m, n]
        c = wp.vec3(v[1], v[2], v[3])
        alpha = alpha_of(v[0], interval)
        weight = trans * alpha
        behind -= weight * wp.dot(g, c)
        trans *= 1.0 - alpha
        h = g * weight
        if has_target == 1:
            h += (c - target[n]) * (2.0 * weight * point_grad[n])
        out = raw_colour_grad(h, c)
        out[0] = interval * sigmoid(v[0]) * (trans * wp.dot(g, c) - behind)
        scatter(grid_grad, index_of(u, radius_of(u), slopes, grid), out)
    if closed == 1:
        far = u0 + du * wp.max(exit_of(u0, du, reach), t_in[n])
        q = index_of(far, radius_of(far), slopes, grid)
        scatter(grid_grad, q, raw_colour_grad(g * trans, colour_of(look_up(grid, q))))
