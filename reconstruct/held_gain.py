"""How well a moving scene is explained where it changes: by pixels of its training pictures that were held back."""

import math
from collections.abc import Callable

import torch

from devrf.capture.scene import Scene
from devrf.reconstruct.held_back import HeldBack
from devrf.reconstruct.model import DynamicModel, Rendered, Seen
from devrf.reconstruct.movers import Layered
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.pictures import training
from devrf.reconstruct.rays import RayBatch, RaySet
from devrf.reconstruct.surroundings import PixelSurroundings

AT_ONCE, EVERY = 1 << 13, 4  # rays; pictures of which one is asked


def held_gain_db(scene: Scene, model: DynamicModel, device: str) -> float:
    """By how much a model of motion explains such pixels better than its scene at rest does.

    Args:
        scene: In the box frame; its moving cameras that are trained on are asked.
        model: Trained on it.
        device: cpu or cuda.
    """
    rays = RaySet(training(scene.dynamic), scene.image_scale, scene.background, device)
    held_back = HeldBack(rays, changing_pixels(rays))
    around = PixelSurroundings(DynamicModel(model.rest), rays)
    still, moving = (
        held_error(rays, held_back, around, box)
        for box in (
            lambda batch: model.box_at_rest(batch.rays_o, batch.rays_d),
            lambda batch: model.box_at(batch.rays_o, batch.rays_d, batch.time),
        )
    )
    return 10 * math.log10(still / moving)


@torch.no_grad()
def held_error(
    rays: RaySet,
    held_back: HeldBack,
    around: PixelSurroundings,
    box: Callable[[RayBatch], Rendered | Seen | Layered],
) -> float:
    """Mean squared error of rays held back, of which some pixel of many pictures is one.

    Args:
        rays: The training pictures.
        held_back: Of these.
        around: What their pixels see beside the box.
        box: What rays see in it.
    """
    total, batch = 0.0, held_back.rays_of(torch.arange(0, len(rays), EVERY))
    assert batch is not None
    for frame, pixel in zip(batch.frame.split(AT_ONCE), batch.pixel.split(AT_ONCE), strict=True):
        some = rays.at(frame, pixel)
        seen = box(some)
        drawn = around.at(frame, pixel).compose(seen.rgb, seen.left)
        total += float(((drawn - some.rgb).double() ** 2).sum())
    return max(total / (3 * len(batch.rgb)), 1e-12)
