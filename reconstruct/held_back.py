"""Pixels of the training pictures that are never trained on: they tell whether more training still gains."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from devrf.reconstruct.moving_pixels import ChangingPixels
from devrf.reconstruct.rays import RayBatch, RaySet

ONE_IN = 32  # pixels is held back
MIX = (2654435761, 40503, 15)  # Knuth's multiplicative hash: pixel, picture, bits shifted out
PER_PICTURE = 256  # asked at once, at most


class HeldBack:
    """Which pixels are held back, and rays through them.

    Args:
        rays: The training pictures.
        changing: Where they change; only those pixels are asked then.
    """

    def __init__(self, rays: RaySet, changing: ChangingPixels | None) -> None:
        self._rays, self._changing = rays, changing

    def without(self, batch: RayBatch) -> RayBatch:
        """A batch less the rays that are held back."""
        return batch.only(~held(batch.frame, batch.pixel))

    def rays_of(self, pictures: Int[Tensor, " f"]) -> RayBatch | None:
        """Rays held back in these pictures, always the same ones; None where there are none."""
        frame, pixel = [], []
        for n in pictures.tolist():
            pixels = self._changing.of_frame[n] if self._changing is not None else None
            if pixels is None or not len(pixels):
                camera = self._rays.cameras[n]
                pixels = torch.arange(camera.width * camera.height, device=self._rays.device)
            mine = pixels[held(torch.full_like(pixels, n), pixels)]
            mine = mine[:: max(1, -(-len(mine) // PER_PICTURE))]
            pixel.append(mine)
            frame.append(torch.full_like(mine, n))
        if not sum(map(len, pixel)):
            return None
        return self._rays.at(torch.cat(frame), torch.cat(pixel))


def held(frame: Int[Tensor, " n"], pixel: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Whether pixels are held back: as good as at random, but always the same."""
    return ((pixel * MIX[0] + frame * MIX[1]) >> MIX[2]) % ONE_IN == 0
