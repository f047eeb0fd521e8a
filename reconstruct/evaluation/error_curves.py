"""How well the motion explains pictures at other times than their clocks say.

Rays carry exact times and the motion interpolates between key times, so the error of a picture is a function of its
camera's offset (Sync-NeRF, Kim et al., AAAI 2024, descends it beside the field).
"""

from collections.abc import Sequence
from statistics import median

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import PosedFrame
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.moving_pixels import ChangingPixels, draw_with_importance

RAYS = 96  # of each picture, where pictures change


@torch.no_grad()
def error_curves(
    model: DynamicModel,
    rays: RaySet,
    around: PixelSurroundings,
    changing: ChangingPixels | None,
    times: Float[Tensor, "F shifts"],
    generator: torch.Generator,
) -> Float[np.ndarray, "F shifts"]:
    """Squared errors of pictures as if they had been taken at each of several times; NaN at times beyond the keys.

    Args:
        model: With its motion.
        rays: The pictures.
        around: What they see outside the box.
        changing: Where they change; only there they are looked at.
        times: Ascending, in the scene's time; NaN: not to be looked at.
        generator: Of the pixels that are looked at.
    """
    assert model.motion is not None  # asked of models with motion only
    curves = np.full(times.shape, np.nan)
    for n, inside in enumerate((times >= model.motion.t_first) & (times <= model.motion.t_last)):
        picture = torch.tensor([n], device=rays.device)
        batch = draw_with_importance(rays, changing, RAYS, 1.0, picture, generator)
        asked = times[n, inside]
        if not len(asked):
            continue
        ray = torch.arange(len(batch.frame), device=rays.device).repeat(len(asked))
        at = asked.repeat_interleave(len(batch.frame))
        seen = model.box_at(batch.rays_o[ray], batch.rays_d[ray], at)
        rgb = around.at(batch.frame[ray], batch.pixel[ray]).compose(seen.rgb, seen.left)
        errors = ((rgb - batch.rgb[ray]) ** 2).reshape(len(asked), -1).sum(1)
        curves[n, inside.cpu().numpy()] = errors.cpu().numpy()
    return curves


def picture_gap_s(frames: Sequence[PosedFrame]) -> float:
    """Time from one picture of a camera to its next."""
    times = sorted(f.time_s for f in frames if f.time_s is not None)
    return median(b - a for a, b in zip(times, times[1:], strict=False)) if len(times) > 1 else 0.0
