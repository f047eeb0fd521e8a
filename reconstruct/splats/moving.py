"""Where points of the scene at rest are at a time: splats live at rest and move by the forward field."""

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.reconstruct.geometry.field import field_at
from devrf.reconstruct.model import DynamicModel


@torch.no_grad()
def moved(model: DynamicModel, x_rest: Float[Tensor, "N 3"], time: float | None) -> Float[Tensor, "N 3"]:
    """Where resting points are at a time (None: at rest), in the box frame; nothing moves outside the motion's box."""
    field = field_at(model, time)
    if field.motion is None:
        return x_rest
    rest = field.from_box(x_rest)
    lo, hi = field.aabb.to(rest)
    inside = ((rest >= lo) & (rest <= hi)).all(1)
    return torch.where(inside[:, None], field.to_box(field.from_rest(rest)), x_rest)
