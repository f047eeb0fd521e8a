# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Adam's step (Kingma & Ba 2015, Algorithm 1) on voxel grids, and the total variation that rides on it.

`masked_step` visits only listed vertices and skips values whose gradient is exactly zero, as DirectVoxGO
does: a voxel no ray touched keeps its value and its moments. `dense_step` moves every value: behind the
motion field's total variation it carries motion into space that no ray has touched, because Adam divides a
gradient by its own size. Both clear the gradient behind them.
"""

import functools
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, launch, use_warp


def masked_step(
    values: Float[Tensor, "V C"],
    grad: Float[Tensor, "P V C"],
    moment1: Float[Tensor, "V C"],
    moment2: Float[Tensor, "V C"],
    vertices: Int[Tensor, " A"],
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float,
    flag: Float[Tensor, " V"] | None = None,
) -> None:
    """One step on the listed vertices, in place; `step` counts from 1; the gradient is the sum over its copies.

    Where `flag` is given, vertices whose flag is 0 are known to have no gradient and are passed over unread.
    """
    rate, root = _corrected(step, lr, betas)
    if use_warp(values.device):
        flags = values.new_zeros(1) if flag is None else flag
        vec, kernel = _masked(values.shape[1])
        arguments = [array(x, vec) for x in (values, grad, moment1, moment2)]
        numbers = [int(flag is not None), rate, root, *betas, eps]
        launch(kernel, len(vertices), [*arguments, array(vertices), array(flags), *numbers], values.device)
        return
    g = grad[:, vertices].sum(0)
    touched = g != 0
    m = torch.where(touched, betas[0] * moment1[vertices] + (1 - betas[0]) * g, moment1[vertices])
    v = torch.where(touched, betas[1] * moment2[vertices] + (1 - betas[1]) * g * g, moment2[vertices])
    moment1[vertices], moment2[vertices] = m, v
    values[vertices] -= torch.where(touched, rate * m / (v.sqrt() * root + eps), 0.0)
    grad[:, vertices] = 0


def dense_step(
    values: Float[Tensor, "*shape"],
    grad: Float[Tensor, "*shape"],
    moment1: Float[Tensor, "*shape"],
    moment2: Float[Tensor, "*shape"],
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """One step on every value, in place; `step` counts from 1."""
    rate, root = _corrected(step, lr, betas)
    if use_warp(values.device):
        arguments = [array(x.reshape(-1)) for x in (values, grad, moment1, moment2)]
        launch(_dense, values.numel(), [*arguments, rate, root, *betas, eps], values.device)
        return
    moment1.lerp_(grad, 1 - betas[0])
    moment2.lerp_(grad * grad, 1 - betas[1])
    values -= rate * moment1 / (moment2.sqrt() * root + eps)
    grad.zero_()


def add_total_variation(
    values: Float[Tensor, "X Y Z C"], grad: Float[Tensor, "X Y Z C"], weight: float, clamp: float
) -> None:
    """Add weight / 6 times the sum over six neighbours of (value - neighbour), held to +-clamp, to `grad`."""
    if use_warp(values.device):
        arguments = [array(values), array(grad), weight / 6.0, clamp]
        launch(_variation, values.numel(), arguments, values.device)
        return
    for axis in range(3):
        n = values.shape[axis]
        difference = (values.narrow(axis, 1, n - 1) - values.narrow(axis, 0, n - 1)).clamp(-clamp, clamp)
        grad.narrow(axis, 1, n - 1).add_(difference, alpha=weight / 6.0)
        grad.narrow(axis, 0, n - 1).sub_(difference, alpha=weight / 6.0)


def add_touched_variation(
    values: Float[Tensor, "X Y Z C"],
    grad: Float[Tensor, "P X Y Z C"],
    vertices: Int[Tensor, " A"],
    weights: Float[Tensor, " C"],
    clamp: float,
) -> None:
    """The same with a weight a channel, to those values of the listed vertices that have a gradient in any copy."""
    channels, copies = values.shape[3], grad.shape[0]
    weights = (weights / 6.0).to(values)
    if use_warp(values.device):
        arguments = [
            array(values),
            array(grad.view(copies, -1, channels)),
            array(vertices),
            array(weights),
            clamp,
        ]
        launch(_touched_variation, len(vertices), arguments, values.device)
        return
    variation = torch.zeros_like(values)
    add_total_variation(values, variation, 6.0, clamp)
    touched = (grad != 0).any(0)
    listed = torch.zeros(touched.shape[:3], dtype=torch.bool, device=values.device)
    listed.view(-1)[vertices] = True
    grad[0] += torch.where(touched & listed[..., None], variation * weights, 0.0)


def _corrected(step: int, lr: float, betas: tuple[float, float]) -> tuple[float, float]:
    """The rate with the first moment's bias taken out, and the factor that does so for the second's root."""
    return lr / (1 - betas[0] ** step), (1 - betas[1] ** step) ** -0.5


@functools.cache
def _masked(channels: int) -> Any:
    vec = wp.types.vector(length=channels, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    @no_type_check
    def masked(
        first: int,
        values: wp.array(dtype=vec),
        grad: wp.array2d(dtype=vec),
        moment1: wp.array(dtype=vec),
        moment2: wp.array(dtype=vec),
        vertices: wp.array(dtype=wp.int64),
        flag: wp.array(dtype=float),
        has_flag: int,
        rate: float,
        root: float,
        beta1: float,
        beta2: float,
        eps: float,
    ):
        v = int(vertices[first + wp.tid()])
        if has_flag == 1:
            if flag[v] == 0.0:
                return
        g = grad[0, v]
        for p in range(1, grad.shape[0]):
            g += grad[p, v]
        if wp.max(wp.abs(g)) == 0.0:  # not its length: squares of small gradients are zero
            return
        m1 = moment1[v]
        m2 = moment2[v]
        x = values[v]
        for c in range(channels):
            if g[c] != 0.0:
                m1[c] = beta1 * m1[c] + (1.0 - beta1) * g[c]
                m2[c] = beta2 * m2[c] + (1.0 - beta2) * g[c] * g[c]
                x[c] = x[c] - rate * m1[c] / (wp.sqrt(m2[c]) * root + eps)
        moment1[v] = m1
        moment2[v] = m2
        values[v] = x
        for p in range(grad.shape[0]):
            grad[p, v] = vec()

    return vec, masked


@wp.kernel(enable_backward=False)
@no_type_check
def _dense(
    first: int,
    values: wp.array(dtype=float),
    grad: wp.array(dtype=float),
    moment1: wp.array(dtype=float),
    moment2: wp.array(dtype=float),
    rate: float,
    root: float,
    beta1: float,
    beta2: float,
    eps: float,
):
    n = first + wp.tid()
    g = grad[n]
    m1 = beta1 * moment1[n] + (1.0 - beta1) * g
    m2 = beta2 * moment2[n] + (1.0 - beta2) * g * g
    moment1[n] = m1
    moment2[n] = m2
    values[n] = values[n] - rate * m1 / (wp.sqrt(m2) * root + eps)
    grad[n] = 0.0


@wp.func
@no_type_check
def _apart(values: wp.array4d(dtype=float), i: int, j: int, k: int, c: int, most: float):
    here = values[i, j, k, c]
    total = float(0.0)
    if i > 0:
        total += wp.clamp(here - values[i - 1, j, k, c], -most, most)
    if i < values.shape[0] - 1:
        total += wp.clamp(here - values[i + 1, j, k, c], -most, most)
    if j > 0:
        total += wp.clamp(here - values[i, j - 1, k, c], -most, most)
    if j < values.shape[1] - 1:
        total += wp.clamp(here - values[i, j + 1, k, c], -most, most)
    if k > 0:
        total += wp.clamp(here - values[i, j, k - 1, c], -most, most)
    if k < values.shape[2] - 1:
        total += wp.clamp(here - values[i, j, k + 1, c], -most, most)
    return total


@wp.kernel(enable_backward=False)
@no_type_check
def _variation(
    first: int, values: wp.array4d(dtype=float), grad: wp.array4d(dtype=float), weight: float, most: float
):
    n = first + wp.tid()
    c = n % values.shape[3]
    k = (n // values.shape[3]) % values.shape[2]
    j = (n // (values.shape[2] * values.shape[3])) % values.shape[1]
    i = n // (values.shape[1] * values.shape[2] * values.shape[3])
    grad[i, j, k, c] = grad[i, j, k, c] + weight * _apart(values, i, j, k, c, most)


@wp.kernel(enable_backward=False)
@no_type_check
def _touched_variation(
    first: int,
    values: wp.array4d(dtype=float),
    grad: wp.array3d(dtype=float),
    vertices: wp.array(dtype=wp.int64),
    weights: wp.array(dtype=float),
    most: float,
):
    v = int(vertices[first + wp.tid()])
    k = v % values.shape[2]
    j = (v // values.shape[2]) % values.shape[1]
    i = v // (values.shape[1] * values.shape[2])
    for c in range(values.shape[3]):
        touched = int(0)
        for p in range(grad.shape[0]):
            if grad[p, v, c] != 0.0:
                touched = 1
        if touched == 1:
            grad[0, v, c] = grad[0, v, c] + weights[c] * _apart(values, i, j, k, c, most)
