# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Trilinear lookup in a voxel grid of C channels, channel last (DeVRF Eq. 1, "Tri-Interp").

Vertices lie on the corners of the box: vertex (0, 0, 0) at its lower corner, the last at its upper corner.
A point outside takes the value of the nearest point of the box, and no gradient flows through the coordinate
that left. The gradient with respect to the grid can be added to a buffer that outlives the step, so that a
large grid with few touched voxels is neither cleared nor copied each time.
"""

import functools
from typing import Any, no_type_check

import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, box_arguments, launch, use_warp


def trilinear(
    grid: Float[Tensor, "X Y Z C"],
    points: Float[Tensor, "N 3"],
    aabb: Float[Tensor, "2 3"],
    grid_grad: Float[Tensor, "X Y Z C"] | None = None,
) -> Float[Tensor, "N C"]:
    """Interpolate `grid` at `points`; differentiable in both.

    Args:
        grid: Values at vertices, at least two along each axis.
        points: Positions, in the units of `aabb`.
        aabb: Corners of the box the grid fills, on the CPU.
        grid_grad: Where given, the grid's gradient is added here and not returned to autograd.
    """
    if min(grid.shape[:3]) < 2:
        raise ValueError(f"a grid needs two vertices along each axis, this one has {tuple(grid.shape[:3])}")
    if not use_warp(grid.device):
        return _trilinear_plain(grid, points, aabb, grid_grad)
    if grid_grad is not None:
        grid = grid.detach().requires_grad_()  # so that autograd comes by
    return _Trilinear.apply(grid, points, aabb, grid_grad)  # type: ignore[return-value]


def trilinear_ref(
    grid: Float[Tensor, "X Y Z C"], points: Float[Tensor, "N 3"], aabb: Float[Tensor, "2 3"]
) -> Float[Tensor, "N C"]:
    """The same in PyTorch's own words."""
    lo, hi = aabb.to(points)
    unit = 2 * (points - lo) / (hi - lo) - 1
    volume = grid.permute(3, 2, 1, 0)[None]  # [1, C, Z, Y, X]: grid_sample's last axis is x
    out = F.grid_sample(
        volume, unit[None, None, None], mode="bilinear", padding_mode="border", align_corners=True
    )
    return out[0, :, 0, 0].T


def _trilinear_plain(grid: Tensor, points: Tensor, aabb: Tensor, grid_grad: Tensor | None) -> Tensor:
    if grid_grad is None:
        return trilinear_ref(grid, points, aabb)
    return trilinear_ref(gathered_in(grid, grid_grad), points, aabb)


def gathered_in(grid: Float[Tensor, "*shape"], buffer: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """The grid as a leaf whose gradient autograd adds to `buffer`."""
    leaf = grid.detach().requires_grad_()
    leaf.register_post_accumulate_grad_hook(lambda g: _move_grad(g, buffer))
    return leaf


def _move_grad(leaf: Tensor, grid_grad: Tensor) -> None:
    if leaf.grad is not None:
        grid_grad += leaf.grad
        leaf.grad = None


class _Trilinear(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, grid: Tensor, points: Tensor, aabb: Tensor, grid_grad: Tensor | None) -> Tensor:
        grid, points = grid.contiguous(), points.contiguous()
        channels = grid.shape[3]
        vec, forward, _ = _kernels(channels)
        lo, scale = box_arguments(aabb, grid.shape[:3])
        out = torch.empty(len(points), channels, device=grid.device)
        arguments = [array(grid, vec), array(points, wp.vec3), wp.vec3(*lo), wp.vec3(*scale), array(out, vec)]
        launch(forward, len(points), arguments, grid.device)
        ctx.save_for_backward(grid, points)
        ctx.box, ctx.grid_grad = (lo, scale), grid_grad
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        grid, points = ctx.saved_tensors
        grad_out = grad_outputs[0].contiguous()
        vec, _, backward = _kernels(grid.shape[3])
        into_buffer, wants_points = ctx.grid_grad is not None, ctx.needs_input_grad[1]
        wants_grid = into_buffer or ctx.needs_input_grad[0]
        grid_grad = ctx.grid_grad if into_buffer else torch.zeros_like(grid) if wants_grid else grid
        points_grad = torch.empty_like(points) if wants_points else points
        lo, scale = ctx.box
        arguments = [
            *(array(grid, vec), array(points, wp.vec3), wp.vec3(*lo), wp.vec3(*scale), array(grad_out, vec)),
            *(array(points_grad, wp.vec3), int(wants_grid), int(wants_points)),
        ]
        if wants_grid:
            launch(backward, len(points), arguments, grid.device, into=[array(grid_grad, vec)])
        else:
            launch(backward, len(points), [*arguments, array(grid_grad, vec)], grid.device)
        returned = grid_grad if wants_grid and not into_buffer else None
        return returned, points_grad if wants_points else None, None, None


@wp.func
@no_type_check
def cell_of(q: float, n: int) -> int:
    """Lower vertex of the cell that holds index coordinate `q` on an axis of `n` vertices."""
    return wp.clamp(int(wp.floor(q)), 0, n - 2)


@wp.func
@no_type_check
def fraction_in(q: float, i: int) -> float:
    """Where in its cell an index coordinate lies, 0 .. 1, held to the border outside."""
    return wp.clamp(q - float(i), 0.0, 1.0)


@wp.func
@no_type_check
def slope_of(q: float, n: int) -> float:
    """1 where an index coordinate is free to move, 0 where it is held to the border."""
    return wp.where(q > 0.0 and q < float(n - 1), 1.0, 0.0)


@wp.func
@no_type_check
def look_up(grid: wp.array3d(dtype=Any), q: wp.vec3):
    """Trilinear value at index coordinates."""
    i = cell_of(q[0], grid.shape[0])
    j = cell_of(q[1], grid.shape[1])
    k = cell_of(q[2], grid.shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    a = (grid[i, j, k] * (1.0 - z) + grid[i, j, k + 1] * z) * (1.0 - y)
    a += (grid[i, j + 1, k] * (1.0 - z) + grid[i, j + 1, k + 1] * z) * y
    b = (grid[i + 1, j, k] * (1.0 - z) + grid[i + 1, j, k + 1] * z) * (1.0 - y)
    b += (grid[i + 1, j + 1, k] * (1.0 - z) + grid[i + 1, j + 1, k + 1] * z) * y
    return a * (1.0 - x) + b * x


@wp.func
@no_type_check
def scatter(grid: wp.array3d(dtype=Any), q: wp.vec3, g: Any):
    """Add to the eight vertices around index coordinates what `look_up` takes of them."""
    i = cell_of(q[0], grid.shape[0])
    j = cell_of(q[1], grid.shape[1])
    k = cell_of(q[2], grid.shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    wp.atomic_add(grid, i, j, k, g * ((1.0 - x) * (1.0 - y) * (1.0 - z)))
    wp.atomic_add(grid, i, j, k + 1, g * ((1.0 - x) * (1.0 - y) * z))
    wp.atomic_add(grid, i, j + 1, k, g * ((1.0 - x) * y * (1.0 - z)))
    wp.atomic_add(grid, i, j + 1, k + 1, g * ((1.0 - x) * y * z))
    wp.atomic_add(grid, i + 1, j, k, g * (x * (1.0 - y) * (1.0 - z)))
    wp.atomic_add(grid, i + 1, j, k + 1, g * (x * (1.0 - y) * z))
    wp.atomic_add(grid, i + 1, j + 1, k, g * (x * y * (1.0 - z)))
    wp.atomic_add(grid, i + 1, j + 1, k + 1, g * (x * y * z))


@wp.func
@no_type_check
def dotted_slope(grid: wp.array3d(dtype=Any), q: wp.vec3, g: Any) -> wp.vec3:
    """By how much the scalar product of what `look_up` finds with `g` rises with index coordinates."""
    i = cell_of(q[0], grid.shape[0])
    j = cell_of(q[1], grid.shape[1])
    k = cell_of(q[2], grid.shape[2])
    x = fraction_in(q[0], i)
    y = fraction_in(q[1], j)
    z = fraction_in(q[2], k)
    v000 = wp.dot(grid[i, j, k], g)
    v001 = wp.dot(grid[i, j, k + 1], g)
    v010 = wp.dot(grid[i, j + 1, k], g)
    v011 = wp.dot(grid[i, j + 1, k + 1], g)
    v100 = wp.dot(grid[i + 1, j, k], g)
    v101 = wp.dot(grid[i + 1, j, k + 1], g)
    v110 = wp.dot(grid[i + 1, j + 1, k], g)
    v111 = wp.dot(grid[i + 1, j + 1, k + 1], g)
    dx = wp.lerp(wp.lerp(v100 - v000, v101 - v001, z), wp.lerp(v110 - v010, v111 - v011, z), y)
    dy = wp.lerp(wp.lerp(v010 - v000, v011 - v001, z), wp.lerp(v110 - v100, v111 - v101, z), x)
    dz = wp.lerp(wp.lerp(v001 - v000, v011 - v010, y), wp.lerp(v101 - v100, v111 - v110, y), x)
    free = wp.vec3(
        slope_of(q[0], grid.shape[0]), slope_of(q[1], grid.shape[1]), slope_of(q[2], grid.shape[2])
    )
    return wp.cw_mul(wp.vec3(dx, dy, dz), free)


@functools.cache
def _kernels(channels: int) -> tuple[Any, Any, Any]:
    vec = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def forward(
        first: int,
        grid: wp.array3d(dtype=vec),
        points: wp.array(dtype=wp.vec3),
        lo: wp.vec3,
        scale: wp.vec3,
        out: wp.array(dtype=vec),
    ):
        n = first + wp.tid()
        out[n] = look_up(grid, wp.cw_mul(points[n] - lo, scale))

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def backward(
        first: int,
        grid: wp.array3d(dtype=vec),
        points: wp.array(dtype=wp.vec3),
        lo: wp.vec3,
        scale: wp.vec3,
        grad_out: wp.array(dtype=vec),
        points_grad: wp.array(dtype=wp.vec3),
        wants_grid: int,
        wants_points: int,
        grid_grad: wp.array3d(dtype=vec),
    ):
        n = first + wp.tid()
        g = grad_out[n]
        q = wp.cw_mul(points[n] - lo, scale)
        if wants_grid == 1:
            scatter(grid_grad, q, g)
        if wants_points == 1:
            points_grad[n] = wp.cw_mul(dotted_slope(grid, q, g), scale)

    return vec, forward, backward
