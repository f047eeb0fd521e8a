# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""A picture of flat Gaussians, near to far (Kerbl et al., 3D Gaussian Splatting, 2023, Section 6).

A Gaussian at m with the inverse covariance A (its *conic*) has at pixel p the opacity
alpha = o exp(-(p - m)' A (p - m) / 2); fainter than `FAINT` it is left out, and it never hides all (`SOLID`). The
picture is cut into tiles; the entries `offsets[n] .. offsets[n + 1]` of tile n name the Gaussians that reach it, near
to far. Gradients are gathered per entry, each by the one thread of its tile, so that their sums have one order.
"""

import math
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, launch, use_warp

TILE = 8  # pixels along each side
FAINT = 1 / 255  # one step of a byte
SOLID = 0.99  # so that what lies behind keeps a gradient
STOP = 1e-4  # transmittance at which a ray ends
NOTHING = math.log(FAINT)  # exponent below which even an opacity of 1 is too faint
_TILE, _FAINT, _SOLID, _STOP, _NOTHING = (wp.constant(v) for v in (TILE, FAINT, SOLID, STOP, NOTHING))


def splat(
    flat: Float[Tensor, "N 9"],
    offsets: Int[Tensor, " tiles_and_one"],
    entries: Int[Tensor, " M"],
    size: tuple[int, int],
    behind: Float[Tensor, " 3"],
) -> Float[Tensor, "H W 3"]:
    """Blend Gaussians; differentiable in them.

    Args:
        flat: Of each: place u, v (pixels; the centre of the first is 0.5), conic xx, xy, yy, opacity, RGB.
        offsets, entries: The tiles' lists, row by row.
        size: Width and height, pixels.
        behind: Colour behind all of them.
    """
    if not use_warp(flat.device):
        return splat_ref(flat, offsets, entries, size, behind)
    return _Splat.apply(flat, offsets, entries, size, behind)  # type: ignore[return-value]


def splat_ref(
    flat: Float[Tensor, "N 9"],
    offsets: Int[Tensor, " tiles_and_one"],
    entries: Int[Tensor, " M"],
    size: tuple[int, int],
    behind: Float[Tensor, " 3"],
) -> Float[Tensor, "H W 3"]:
    """The same, tile by tile."""
    width, height = size
    across = -(-width // TILE)
    rows = []
    for row in range(-(-height // TILE)):
        tiles = []
        for column in range(across):
            n = row * across + column
            tile = flat[entries[int(offsets[n]) : int(offsets[n + 1])].long()]
            v, u = torch.meshgrid(*(torch.arange(TILE, device=flat.device) + 0.5,) * 2, indexing="ij")
            x, y = u + column * TILE - tile[:, 0, None, None], v + row * TILE - tile[:, 1, None, None]
            a, b, c, opacity = (tile[:, k, None, None] for k in (2, 3, 4, 5))
            alpha = opacity * torch.exp(-0.5 * (a * x * x + 2 * b * x * y + c * y * y))
            alpha = torch.where(alpha < FAINT, 0.0, alpha.clamp(max=SOLID))
            trans = torch.cumprod(torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]), dim=0)
            reached = trans[:-1] >= STOP
            left = torch.where(reached, 1 - alpha, 1.0).prod(0)
            weights = torch.where(reached, trans[:-1] * alpha, 0.0)
            tiles.append(torch.einsum("nyx,nc->yxc", weights, tile[:, 6:]) + left[..., None] * behind)
        rows.append(torch.cat(tiles, dim=1) if tiles else flat.new_zeros(TILE, 0, 3))
    return torch.cat(rows)[:height, :width]


class _Splat(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, flat: Tensor, offsets: Tensor, entries: Tensor, size: tuple[int, int], behind: Tensor
    ) -> Tensor:
        width, height = size
        listed = flat[entries]  # in the order in which tiles read them, which is quicker
        picture = flat.new_empty(height, width, 3)
        arguments = [array(listed), array(offsets), width, array(behind), array(picture)]
        launch(_forward, width * height, arguments, flat.device)
        ctx.save_for_backward(listed, offsets, entries, picture)
        ctx.count = len(flat)
        return picture

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None, None]:
        listed, offsets, entries, picture = ctx.saved_tensors
        grads = torch.zeros_like(listed)
        arguments = [array(listed), array(offsets), picture.shape[1], picture.shape[0]]
        arguments += [array(picture), array(grad_outputs[0].contiguous()), array(grads)]
        launch(_backward, len(offsets) - 1, arguments, listed.device)
        return listed.new_zeros(ctx.count, 9).index_add_(0, entries, grads), None, None, None, None


@wp.func
@no_type_check
def _alpha(flat: wp.array2d(dtype=float), e: int, x: float, y: float) -> float:
    """Opacity at (x, y) from the middle; 0 where it is too faint, which is most often, before the exponential."""
    power = -0.5 * (flat[e, 2] * x * x + flat[e, 4] * y * y) - flat[e, 3] * x * y
    if power < _NOTHING:
        return 0.0
    alpha = flat[e, 5] * wp.exp(power)
    return wp.where(alpha < _FAINT, 0.0, alpha)


@wp.kernel(enable_backward=False)
@no_type_check
def _forward(
    first: int,
    flat: wp.array2d(dtype=float),
    offsets: wp.array(dtype=wp.int64),
    width: int,
    behind: wp.array(dtype=float),
    picture: wp.array3d(dtype=float),
):
    p = first + wp.tid()
    column = p % width
    row = p // width
    u = float(column) + 0.5
    v = float(row) + 0.5
    n = (row // _TILE) * ((width + _TILE - 1) // _TILE) + column // _TILE
    trans = float(1.0)
    rgb = wp.vec3(0.0, 0.0, 0.0)
    e = int(offsets[n])
    end = int(offsets[n + 1])
    while e < end and trans >= _STOP:
        alpha = wp.min(_alpha(flat, e, u - flat[e, 0], v - flat[e, 1]), _SOLID)
        if alpha > 0.0:
            rgb += trans * alpha * wp.vec3(flat[e, 6], flat[e, 7], flat[e, 8])
            trans = trans * (1.0 - alpha)
        e += 1
    for k in range(3):
        picture[row, column, k] = rgb[k] + trans * behind[k]


@wp.kernel(enable_backward=False)
@no_type_check
def _backward(
    first: int,
    flat: wp.array2d(dtype=float),
    offsets: wp.array(dtype=wp.int64),
    width: int,
    height: int,
    picture: wp.array3d(dtype=float),
    picture_grad: wp.array3d(dtype=float),
    grads: wp.array2d(dtype=float),
):
    # d picture / d alpha_i = trans_i colour_i - (what lies behind i) / (1 - alpha_i), as in background.py
    n = first + wp.tid()
    across = (width + _TILE - 1) // _TILE
    for k in range(_TILE * _TILE):
        column = (n % across) * _TILE + k % _TILE
        row = (n // across) * _TILE + k // _TILE
        if column < width and row < height:
            grad = wp.vec3(
                picture_grad[row, column, 0], picture_grad[row, column, 1], picture_grad[row, column, 2]
            )
            behind = wp.vec3(picture[row, column, 0], picture[row, column, 1], picture[row, column, 2])
            trans = float(1.0)
            e = int(offsets[n])
            end = int(offsets[n + 1])
            while e < end and trans >= _STOP:
                x = float(column) + 0.5 - flat[e, 0]
                y = float(row) + 0.5 - flat[e, 1]
                whole = _alpha(flat, e, x, y)
                if whole > 0.0:
                    alpha = wp.min(whole, _SOLID)
                    colour = wp.vec3(flat[e, 6], flat[e, 7], flat[e, 8])
                    weight = trans * alpha
                    behind -= weight * colour
                    grads[e, 6] += weight * grad[0]
                    grads[e, 7] += weight * grad[1]
                    grads[e, 8] += weight * grad[2]
                    if whole < _SOLID:
                        slope = (trans * wp.dot(colour, grad) - wp.dot(behind, grad) / (1.0 - alpha)) * alpha
                        grads[e, 5] += slope / flat[e, 5]
                        grads[e, 0] += slope * (flat[e, 2] * x + flat[e, 3] * y)
                        grads[e, 1] += slope * (flat[e, 3] * x + flat[e, 4] * y)
                        grads[e, 2] -= 0.5 * slope * x * x
                        grads[e, 3] -= slope * x * y
                        grads[e, 4] -= 0.5 * slope * y * y
                    trans = trans * (1.0 - alpha)
                e += 1
