"""The losses, one function per equation of the paper, and what the published program adds.

R rays, S samples that the march kept. Weights stand in options.py. Total variation (Eq. 7) is applied to the
gradient directly, `kernels/adam.py: add_total_variation`.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

VARIATION_RESOLUTION, VARIATION_CLAMP = 128, 1.0  # published: differences beyond 1 pull no harder
EDGE = 1e-6  # a transmittance is held this far from 0 and 1, where the entropy's slope is infinite


def rendering_loss(rgb: Float[Tensor, "R 3"], target: Float[Tensor, "R 3"]) -> Float[Tensor, ""]:
    """Re-rendering loss, DeVRF Eq. 4; mean over channels (the program's), not their sum (the paper's)."""
    return ((rgb - target) ** 2).mean()


def cycle_loss(x_t: Float[Tensor, "S 3"], x_t_again: Float[Tensor, "S 3"]) -> Float[Tensor, ""]:
    """Cycle consistency, DeVRF Eq. 5: half the mean squared distance between a point and its round trip.

    Over the samples the march kept (the program's choice); lengths in units of the published objects' scale.
    """
    return 0.5 * ((x_t - x_t_again) ** 2).sum(-1).mean() if len(x_t) else x_t.sum()


def flow_loss(
    moved_px: Float[Tensor, "S 2"],
    target_px: Float[Tensor, "S 2"],
    weights: Float[Tensor, " S"],
    confidence: Float[Tensor, " S"],
    agreement: Float[Tensor, " S"],
) -> Float[Tensor, ""]:
    """Optical flow supervision, DeVRF Eq. 6: weighted L1 distance between where a point was and where flow says.

    As the program has it: divided by twice the number of valid samples instead of the number of rays, weights
    not detached, and only pixels whose flow is consistent forward and backward. Departure: distances are in
    pixels of a picture 400 wide (the published size), so that the weight does not depend on resolution; and a vector
    counts by its confidence, from 0 to 1, where the published program has 0 or 1 (`reference` keeps these), times how
    far the pictures agree with it. That is not divided by: vectors that are all wrong are not to count as much as
    vectors that are all right.
    """
    apart = (moved_px - target_px).abs().sum(-1)
    kept = torch.where(confidence > 0, confidence * agreement * weights * apart, 0.0)
    return kept.sum() / (2 * confidence.sum() + 1e-8)


def variation_weight(weight: float, shape: tuple[int, ...], rays: int) -> float:
    """Weight of total variation (DeVRF Eq. 7) in a gradient, as the program has it: by resolution and rays."""
    return weight * max(shape) / VARIATION_RESOLUTION / rays


def entropy_loss(left: Float[Tensor, " R"]) -> Float[Tensor, ""]:
    """Not in the paper: each ray's remaining transmittance should be near 0 or 1 (DirectVoxGO's background loss)."""
    p = left.clamp(EDGE, 1 - EDGE)
    return -(p * p.log() + (1 - p) * (1 - p).log()).mean()


def per_point_loss(
    weights: Float[Tensor, " S"],
    colours: Float[Tensor, "S 3"] | None,
    target: Float[Tensor, "R 3"],
    ray_id: Int[Tensor, " S"],
) -> Float[Tensor, ""]:
    """Not in the paper: each sample's colour should be its ray's, by its (constant) weight (DirectVoxGO).

    Nothing where colours are found per ray.
    """
    if colours is None:
        return target.new_zeros(())
    apart = ((colours - target[ray_id]) ** 2).sum(-1)
    return (weights.detach() * apart).sum() / max(1, len(target))


def opacity_loss(left: Float[Tensor, " R"], opacity: Float[Tensor, " R"]) -> Float[Tensor, ""]:
    """Not in the paper: transmittance should be what the matte says.

    The published forward-facing recipe has this loss but reads a colour channel for the matte. It removes fog of
    the background's own colour, which the re-rendering loss cannot see.
    """
    return ((left - (1 - opacity)) ** 2).mean()
