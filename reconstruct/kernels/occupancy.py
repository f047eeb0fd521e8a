# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Which space is empty, as the distance to the nearest occupied vertex, so that a march can leap.

Distances are Chebyshev distances in vertices, 0 where occupied, held to `REACH`. Both for the scene at rest
and, through the backward motion, for the scene at given times.
"""

from typing import no_type_check

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, box_arguments, launch, use_warp
from devrf.reconstruct.kernels.quad import motion_at_time, quad_ref

REACH = 6  # vertices; farther leaps would save little and cost more to prepare


def distance(occupied: Bool[Tensor, "X Y Z"]) -> UInt8[Tensor, "X Y Z"]:
    """Chebyshev distance of each vertex to the nearest occupied one, at most `REACH`."""
    if not use_warp(occupied.device):
        return distance_ref(occupied)
    out = torch.where(occupied, 0, REACH).to(torch.uint8)
    for axis in range(3):  # the largest of three one-dimensional distances, one axis after the other
        source, out = out, torch.empty_like(out)
        launch(_spread, out.numel(), [array(source), axis, array(out)], out.device)
    return out


def distance_ref(occupied: Bool[Tensor, "X Y Z"]) -> UInt8[Tensor, "X Y Z"]:
    """The same by growing the occupied set a vertex at a time."""
    grown = occupied.float()[None, None]
    out = torch.where(occupied, 0.0, float(REACH))
    for step in range(1, REACH):
        grown = F.max_pool3d(grown, 3, stride=1, padding=1)
        out = torch.where((grown[0, 0] > 0) & (out > step), float(step), out)
    return out.to(torch.uint8)


def moved_occupancy(
    shape: tuple[int, int, int],
    aabb: Float[Tensor, "2 3"],
    field: Float[Tensor, "T X Y Z 3"],
    taus: Float[Tensor, " M"],
    rest_distance: UInt8[Tensor, "A B C"],
    rest_aabb: Float[Tensor, "2 3"],
    reach: int,
) -> Bool[Tensor, "D E F"]:
    """Vertices near which the scene may be occupied at any of the times `taus`.

    Args:
        shape: Vertices of the answer, over `aabb`.
        aabb: Box of the motion field [2, 3], on the CPU.
        field: Backward motion at key times; a point x at time t shows what rests at x + field(x, t).
        taus: Times to look at, in key spacings.
        rest_distance: Distances of the scene at rest, over `rest_aabb`.
        rest_aabb: Box of the scene at rest [2, 3], on the CPU.
        reach: How near, in vertices of the scene at rest, counts; at most REACH - 1.
    """
    if not use_warp(field.device):
        return _moved_occupancy_ref(shape, aabb, field, taus, rest_distance, rest_aabb, reach)
    out = torch.empty(shape, dtype=torch.uint8, device=field.device)
    lo, scale = box_arguments(aabb, shape)
    rest_lo, rest_scale = box_arguments(rest_aabb, tuple(rest_distance.shape))
    _, field_scale = box_arguments(aabb, field.shape[1:4])
    arguments = [
        *(array(field, wp.vec3), array(taus), wp.vec3(*lo), wp.vec3(*scale), wp.vec3(*field_scale)),
        *(array(rest_distance), wp.vec3(*rest_lo), wp.vec3(*rest_scale), reach, array(out)),
    ]
    launch(_moved, out.numel(), arguments, out.device)
    return out.bool()


def _moved_occupancy_ref(
    shape: tuple[int, int, int],
    aabb: Tensor,
    field: Tensor,
    taus: Tensor,
    rest_distance: Tensor,
    rest_aabb: Tensor,
    reach: int,
) -> Tensor:
    axes = [torch.linspace(a, b, n) for a, b, n in zip(*aabb.tolist(), shape, strict=True)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3).to(field)
    out = torch.zeros(len(points), dtype=torch.bool, device=field.device)
    last = torch.tensor(rest_distance.shape, device=field.device) - 1
    rest_lo, rest_hi = rest_aabb.to(field)
    for tau in taus:
        rest = points + quad_ref(field, points, tau.expand(len(points)).contiguous(), aabb)
        vertex = ((rest - rest_lo) / (rest_hi - rest_lo) * last).round()
        held = vertex.clamp(min=torch.zeros_like(last), max=last)
        away = rest_distance[tuple(held.long().unbind(-1))] + (vertex - held).abs().amax(-1)
        out |= away <= reach
    return out.reshape(shape)


@wp.kernel(enable_backward=False)
@no_type_check
def _spread(first: int, source: wp.array3d(dtype=wp.uint8), axis: int, out: wp.array3d(dtype=wp.uint8)):
    n = first + wp.tid()
    k = n % source.shape[2]
    j = (n // source.shape[2]) % source.shape[1]
    i = n // (source.shape[1] * source.shape[2])
    best = int(source[i, j, k])
    for step in range(1, REACH):
        if step >= best:
            break
        for side in range(2):
            move = wp.where(side == 0, -step, step)
            a = i + wp.where(axis == 0, move, 0)
            b = j + wp.where(axis == 1, move, 0)
            c = k + wp.where(axis == 2, move, 0)
            if (
                a >= 0
                and b >= 0
                and c >= 0
                and a < source.shape[0]
                and b < source.shape[1]
                and c < source.shape[2]
            ):
                best = wp.min(best, wp.max(step, int(source[a, b, c])))
    out[i, j, k] = wp.uint8(best)


@wp.kernel(enable_backward=False)
@no_type_check
def _moved(
    first: int,
    field: wp.array4d(dtype=wp.vec3),
    taus: wp.array(dtype=float),
    lo: wp.vec3,
    scale: wp.vec3,
    field_scale: wp.vec3,
    rest: wp.array3d(dtype=wp.uint8),
    rest_lo: wp.vec3,
    rest_scale: wp.vec3,
    reach: int,
    out: wp.array3d(dtype=wp.uint8),
):
    n = first + wp.tid()
    k = n % out.shape[2]
    j = (n // out.shape[2]) % out.shape[1]
    i = n // (out.shape[1] * out.shape[2])
    point = lo + wp.cw_div(wp.vec3(float(i), float(j), float(k)), scale)
    found = int(0)
    for m in range(taus.shape[0]):
        moved = point + motion_at_time(field, taus[m], wp.cw_mul(point - lo, field_scale))
        q = wp.cw_mul(moved - rest_lo, rest_scale)
        a = int(wp.floor(q[0] + 0.5))
        b = int(wp.floor(q[1] + 0.5))
        c = int(wp.floor(q[2] + 0.5))
        ha = wp.clamp(a, 0, rest.shape[0] - 1)
        hb = wp.clamp(b, 0, rest.shape[1] - 1)
        hc = wp.clamp(c, 0, rest.shape[2] - 1)
        outside = wp.max(wp.max(wp.abs(a - ha), wp.abs(b - hb)), wp.abs(c - hc))
        if int(rest[ha, hb, hc]) + outside <= reach:
            found = 1
            break
    out[i, j, k] = wp.uint8(found)
