# ruff: noqa: UP018 (float(1.0) makes a variable in a Warp kernel, 1.0 a constant)
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportOperatorIssue=false, reportAttributeAccessIssue=false
"""Alpha compositing of packed samples (DeVRF Eq. 3; Mildenhall et al. 2020, Eq. 3).

The samples of ray r are the entries `offsets[r] .. offsets[r+1]`, near to far. A sample's weight is its alpha
times the transmittance before it; what is left behind the last sample is the ray's transmittance.
"""

from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from devrf.reconstruct.kernels.launch import array, launch, use_warp

OPAQUE = 1e-6  # 1 - alpha is held above this where it divides


def composite_weights(
    alpha: Float[Tensor, " S"], offsets: Int[Tensor, " rays_and_one"]
) -> tuple[Float[Tensor, " S"], Float[Tensor, " R"]]:
    """Weights [S] of the samples and remaining transmittance [R] of the rays; differentiable."""
    if not use_warp(alpha.device):
        return composite_weights_ref(alpha, offsets)
    return _Composite.apply(alpha, offsets)  # type: ignore[return-value]


def composite_weights_ref(
    alpha: Float[Tensor, " S"], offsets: Int[Tensor, " rays_and_one"]
) -> tuple[Float[Tensor, " S"], Float[Tensor, " R"]]:
    """The same, ray by ray."""
    weights, left = [], []
    for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
        trans = torch.cumprod(torch.cat([alpha.new_ones(1), 1 - alpha[a:b]]), dim=0)
        weights.append(trans[:-1] * alpha[a:b])
        left.append(trans[-1])
    return torch.cat(weights) if weights else alpha, torch.stack(left) if left else alpha.new_zeros(0)


def accumulate(
    weights: Float[Tensor, " S"], values: Float[Tensor, "S C"], ray_id: Int[Tensor, " S"], rays: int
) -> Float[Tensor, "rays C"]:
    """Sum of weights times values along each ray (plain PyTorch; its sums have one order on the CPU)."""
    out = values.new_zeros(rays, values.shape[1])
    return out.index_add(0, ray_id, weights[:, None] * values)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, alpha: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
        alpha, rays = alpha.contiguous(), len(offsets) - 1
        weights, left = torch.empty_like(alpha), alpha.new_ones(rays)
        arguments = [array(alpha), array(offsets), array(weights), array(left)]
        launch(_forward, rays, arguments, alpha.device)
        ctx.save_for_backward(alpha, offsets, weights, left)
        return weights, left

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        alpha, offsets, weights, left = ctx.saved_tensors
        alpha_grad = torch.empty_like(alpha)
        grads = [array(g.contiguous()) for g in grad_outputs]
        arguments = [array(alpha), array(offsets), array(weights), array(left), *grads, array(alpha_grad)]
        launch(_backward, len(offsets) - 1, arguments, alpha.device)
        return alpha_grad, None


@wp.kernel(enable_backward=False)
@no_type_check
def _forward(
    first: int,
    alpha: wp.array(dtype=float),
    offsets: wp.array(dtype=wp.int64),
    weights: wp.array(dtype=float),
    left: wp.array(dtype=float),
):
    r = first + wp.tid()
    trans = float(1.0)
    for s in range(int(offsets[r]), int(offsets[r + 1])):
        weights[s] = trans * alpha[s]
        trans = trans * (1.0 - alpha[s])
    left[r] = trans


@wp.kernel(enable_backward=False)
@no_type_check
def _backward(
    first: int,
    alpha: wp.array(dtype=float),
    offsets: wp.array(dtype=wp.int64),
    weights: wp.array(dtype=float),
    left: wp.array(dtype=float),
    weights_grad: wp.array(dtype=float),
    left_grad: wp.array(dtype=float),
    alpha_grad: wp.array(dtype=float),
):
    # d w_j / d alpha_i = -w_j / (1 - alpha_i) for j > i, and the same for what is left: sum from the back
    r = first + wp.tid()
    behind = left[r] * left_grad[r]
    a = int(offsets[r])
    b = int(offsets[r + 1])
    for n in range(b - a):
        s = b - 1 - n
        clear = wp.max(1.0 - alpha[s], OPAQUE)
        trans = wp.where(alpha[s] > 0.0, weights[s] / wp.max(alpha[s], 1.0e-30), 0.0)
        alpha_grad[s] = trans * weights_grad[s] - behind / clear
        behind += weights[s] * weights_grad[s]
