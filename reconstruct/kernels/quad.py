# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Lookup of a motion in space and time (DeVRF Eq. 2, "Quad-Interp").

A field holds a displacement per key time and voxel; a point's displacement is the blend of the two key times
around its own time, each interpolated trilinearly. Key times are uniform, and a time is given in units of
their spacing: `tau` = 3.25 lies a quarter of the way from key 3 to key 4. Edges are as in trilinear.py.
"""

from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, box_arguments, copies_for, launch, use_warp
from devrf.reconstruct.kernels.trilinear import cell_of, fraction_in, gathered_in, slope_of, trilinear_ref


def quad(
    field: Float[Tensor, "T X Y Z 3"],
    points: Float[Tensor, "N 3"],
    tau: Float[Tensor, " N"],
    aabb: Float[Tensor, "2 3"],
    keys_grad: Float[Tensor, "K X Y Z 3"] | None = None,
    first_key: int = 0,
) -> Float[Tensor, "N 3"]:
    """Interpolate `field` at points and times; differentiable in field and points (not in time).

    Args:
        field: Displacements at key times and vertices; at least two key times.
        points: Positions, in the units of `aabb`.
        tau: Time of each point, in key spacings; held to [0, T-1].
        aabb: Corners of the box the field fills, on the CPU.
        keys_grad: Where given, the gradient for key times first_key .. first_key + K - 1 is added here, and
            none is returned to autograd.
        first_key: See `keys_grad`.
    """
    if len(field) < 2 or min(field.shape[1:4]) < 2:
        text = f"a field needs two key times and two vertices per axis, not {tuple(field.shape[:4])}"
        raise ValueError(text)
    if not use_warp(field.device):
        return _quad_plain(field, points, tau, aabb, keys_grad, first_key)
    if keys_grad is not None:
        field = field.detach().requires_grad_()  # so that autograd comes by
    return _Quad.apply(field, points, tau, aabb, keys_grad, first_key)  # type: ignore[return-value]


def quad_ref(
    field: Float[Tensor, "T X Y Z 3"],
    points: Float[Tensor, "N 3"],
    tau: Float[Tensor, " N"],
    aabb: Float[Tensor, "2 3"],
) -> Float[Tensor, "N 3"]:
    """The same: every key time at every point, then the two that count."""
    tau = tau.clamp(0, len(field) - 1)
    key = tau.floor().long().clamp(max=len(field) - 2)
    at_keys = torch.stack([trilinear_ref(grid, points, aabb) for grid in field])
    n = torch.arange(len(points), device=points.device)
    return torch.lerp(at_keys[key, n], at_keys[key + 1, n], (tau - key)[:, None])


def _quad_plain(
    field: Tensor, points: Tensor, tau: Tensor, aabb: Tensor, keys_grad: Tensor | None, first_key: int
) -> Tensor:
    if keys_grad is None:
        return quad_ref(field, points, tau, aabb)
    keys = slice(first_key, first_key + len(keys_grad))
    leaf = gathered_in(field[keys], keys_grad)
    whole = torch.cat([field[: keys.start].detach(), leaf, field[keys.stop :].detach()])
    return quad_ref(whole, points, tau, aabb)


class _Quad(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        field: Tensor,
        points: Tensor,
        tau: Tensor,
        aabb: Tensor,
        keys_grad: Tensor | None,
        first_key: int,
    ) -> Tensor:
        field, points, tau = field.contiguous(), points.contiguous(), tau.contiguous()
        lo, scale = box_arguments(aabb, field.shape[1:4])
        out = torch.empty_like(points)
        arguments = [array(field, wp.vec3), array(points, wp.vec3), array(tau), wp.vec3(*lo), wp.vec3(*scale)]
        launch(_forward, len(points), [*arguments, array(out, wp.vec3)], field.device)
        ctx.save_for_backward(field, points, tau)
        ctx.box, ctx.keys_grad, ctx.first_key = (lo, scale), keys_grad, first_key
        return out

    @staticmethod
    def backward(
        ctx: Any, *grad_outputs: Tensor
    ) -> tuple[Tensor | None, Tensor | None, None, None, None, None]:
        field, points, tau = ctx.saved_tensors
        grad_out = grad_outputs[0].contiguous()
        into_buffer, wants_points = ctx.keys_grad is not None, ctx.needs_input_grad[1]
        wants_field = into_buffer or ctx.needs_input_grad[0]
        field_grad = ctx.keys_grad if into_buffer else torch.zeros_like(field) if wants_field else field
        points_grad = torch.empty_like(points) if wants_points else points
        lo, scale = ctx.box
        arguments = [
            *(array(field, wp.vec3), array(points, wp.vec3), array(tau), wp.vec3(*lo), wp.vec3(*scale)),
            *(array(grad_out, wp.vec3), ctx.first_key, int(wants_field)),
            *(array(points_grad, wp.vec3), int(wants_points)),
        ]
        if wants_field:
            more = [torch.zeros_like(field_grad) for _ in range(copies_for(field.device) - 1)]
            into = [array(copy, wp.vec3) for copy in (field_grad, *more)]
            launch(_backward, len(points), arguments, field.device, into=into)
            for copy in more:
                field_grad += copy
        else:
            launch(_backward, len(points), [*arguments, array(field_grad, wp.vec3)], field.device)
        returned = field_grad if wants_field and not into_buffer else None
        return returned, points_grad if wants_points else None, None, None, None, None


@wp.func
@no_type_check
def motion_at(field: wp.array4d(dtype=wp.vec3), t: int, q: wp.vec3) -> wp.vec3:
    """Displacement of key time `t` at index coordinates `q`."""
    i = cell_of(q[0], field.shape[1])
    j = cell_of(q[1], field.shape[2])
    k = cell_of(q[2], field.shape[3])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    a = (field[t, i, j, k] * (1.0 - z) + field[t, i, j, k + 1] * z) * (1.0 - y)
    a += (field[t, i, j + 1, k] * (1.0 - z) + field[t, i, j + 1, k + 1] * z) * y
    b = (field[t, i + 1, j, k] * (1.0 - z) + field[t, i + 1, j, k + 1] * z) * (1.0 - y)
    b += (field[t, i + 1, j + 1, k] * (1.0 - z) + field[t, i + 1, j + 1, k + 1] * z) * y
    return a * (1.0 - x) + b * x


@wp.func
@no_type_check
def motion_at_time(field: wp.array4d(dtype=wp.vec3), tau: float, q: wp.vec3) -> wp.vec3:
    """Displacement at time `tau` (key spacings) and index coordinates `q`; one key time if that is enough."""
    t = cell_of(tau, field.shape[0])
    w = fraction_in(tau, t)
    if w == 0.0:
        return motion_at(field, t, q)
    if w == 1.0:
        return motion_at(field, t + 1, q)
    return motion_at(field, t, q) * (1.0 - w) + motion_at(field, t + 1, q) * w


@wp.kernel(enable_backward=False)
@no_type_check
def _forward(
    first: int,
    field: wp.array4d(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    tau: wp.array(dtype=float),
    lo: wp.vec3,
    scale: wp.vec3,
    out: wp.array(dtype=wp.vec3),
):
    n = first + wp.tid()
    out[n] = motion_at_time(field, tau[n], wp.cw_mul(points[n] - lo, scale))


@wp.kernel(enable_backward=False)
@no_type_check
def _backward(
    first: int,
    field: wp.array4d(dtype=wp.vec3),
    points: wp.array(dtype=wp.vec3),
    tau: wp.array(dtype=float),
    lo: wp.vec3,
    scale: wp.vec3,
    grad_out: wp.array(dtype=wp.vec3),
    first_key: int,
    wants_field: int,
    points_grad: wp.array(dtype=wp.vec3),
    wants_points: int,
    field_grad: wp.array4d(dtype=wp.vec3),
):
    n = first + wp.tid()
    g = grad_out[n]
    q = wp.cw_mul(points[n] - lo, scale)
    i = cell_of(q[0], field.shape[1])
    j = cell_of(q[1], field.shape[2])
    k = cell_of(q[2], field.shape[3])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    t = cell_of(tau[n], field.shape[0])
    w = fraction_in(tau[n], t)
    dx = float(0.0)
    dy = float(0.0)
    dz = float(0.0)
    for s in range(2):
        ws = wp.where(s == 0, 1.0 - w, w)
        slot = t + s - first_key
        if ws > 0.0:
            if wants_field == 1 and slot >= 0 and slot < field_grad.shape[0]:
                h = g * ws
                wp.atomic_add(field_grad, slot, i, j, k, h * ((1.0 - x) * (1.0 - y) * (1.0 - z)))
                wp.atomic_add(field_grad, slot, i, j, k + 1, h * ((1.0 - x) * (1.0 - y) * z))
                wp.atomic_add(field_grad, slot, i, j + 1, k, h * ((1.0 - x) * y * (1.0 - z)))
                wp.atomic_add(field_grad, slot, i, j + 1, k + 1, h * ((1.0 - x) * y * z))
                wp.atomic_add(field_grad, slot, i + 1, j, k, h * (x * (1.0 - y) * (1.0 - z)))
                wp.atomic_add(field_grad, slot, i + 1, j, k + 1, h * (x * (1.0 - y) * z))
                wp.atomic_add(field_grad, slot, i + 1, j + 1, k, h * (x * y * (1.0 - z)))
                wp.atomic_add(field_grad, slot, i + 1, j + 1, k + 1, h * (x * y * z))
            if wants_points == 1:
                v000 = wp.dot(field[t + s, i, j, k], g)
                v001 = wp.dot(field[t + s, i, j, k + 1], g)
                v010 = wp.dot(field[t + s, i, j + 1, k], g)
                v011 = wp.dot(field[t + s, i, j + 1, k + 1], g)
                v100 = wp.dot(field[t + s, i + 1, j, k], g)
                v101 = wp.dot(field[t + s, i + 1, j, k + 1], g)
                v110 = wp.dot(field[t + s, i + 1, j + 1, k], g)
                v111 = wp.dot(field[t + s, i + 1, j + 1, k + 1], g)
                dx += ws * wp.lerp(
                    wp.lerp(v100 - v000, v101 - v001, z), wp.lerp(v110 - v010, v111 - v011, z), y
                )
                dy += ws * wp.lerp(
                    wp.lerp(v010 - v000, v011 - v001, z), wp.lerp(v110 - v100, v111 - v101, z), x
                )
                dz += ws * wp.lerp(
                    wp.lerp(v001 - v000, v011 - v010, y), wp.lerp(v101 - v100, v111 - v110, y), x
                )
    if wants_points == 1:
        free = wp.vec3(
            slope_of(q[0], field.shape[1]), slope_of(q[1], field.shape[2]), slope_of(q[2], field.shape[3])
        )
        points_grad[n] = wp.cw_mul(wp.cw_mul(wp.vec3(dx, dy, dz), scale), free)
