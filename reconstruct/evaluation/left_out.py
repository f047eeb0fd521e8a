"""Pixels of the training pictures that training leaves out, always the same ones, and the pictures asked by them.

Tracking and optical flow read whole pictures, these pixels too: what they decide is decided by pixels left out of
training, not by pictures that nothing has seen.
"""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from devrf.capture.system.spread import spread
from devrf.reconstruct.evaluation.paired import LEAST_MOMENTS
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.moving_pixels import ChangingPixels

ONE_IN = 32  # pixels is left out
MIX = (2654435761, 40503, 15)  # Knuth's multiplicative hash: pixel, picture, bits shifted out
PER_PICTURE = 256  # asked at once, at most
EVERY = 4  # pictures of a camera, of which one is asked where that leaves enough of them


class LeftOut:
    """Which pixels are left out, and rays through them.

    Args:
        rays: The training pictures.
        changing: Where they change; only those pixels are asked then.
        pictures: Numbers of those that are trained on; None: all.
    """

    def __init__(
        self, rays: RaySet, changing: ChangingPixels | None, pictures: Int[Tensor, " f"] | None = None
    ) -> None:
        self._rays, self._changing, self._pictures = rays, changing, pictures

    def without(self, batch: RayBatch) -> RayBatch:
        """A batch less the rays that are left out."""
        return batch.only(~left_out(batch.frame, batch.pixel))

    def asked(self) -> Int[Tensor, " f"]:
        """Some pictures of every camera, evenly over its time: one of EVERY, but enough to tell gains from chance."""
        by_camera: dict[str, list[int]] = {}
        frames = self._rays.frames
        for n in sorted(range(len(frames)), key=lambda n: frames[n].time or 0.0):
            by_camera.setdefault(frames[n].camera_name, []).append(n)
        chosen = [
            n for mine in by_camera.values() for n in spread(mine, max(LEAST_MOMENTS, -(-len(mine) // EVERY)))
        ]
        asked = torch.tensor(sorted(chosen))
        return asked if self._pictures is None else asked[torch.isin(asked, self._pictures)]

    def rays_of(self, pictures: Int[Tensor, " f"]) -> RayBatch | None:
        """Rays left out in these pictures, always the same ones; None where there are none."""
        frame, pixel = [], []
        for n in pictures.tolist():
            pixels = self._changing.of_frame[n] if self._changing is not None else None
            if pixels is None or not len(pixels):
                camera = self._rays.cameras[n]
                pixels = torch.arange(camera.width * camera.height, device=self._rays.device)
            mine = pixels[left_out(torch.full_like(pixels, n), pixels)]
            mine = mine[:: max(1, -(-len(mine) // PER_PICTURE))]
            pixel.append(mine)
            frame.append(torch.full_like(mine, n))
        if not sum(map(len, pixel)):
            return None
        return self._rays.at(torch.cat(frame), torch.cat(pixel))


def left_out(picture: Int[Tensor, " n"], pixel: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
    """Whether pixels are left out, by their picture's number: as good as at random, but always the same."""
    return ((pixel * MIX[0] + picture * MIX[1]) >> MIX[2]) % ONE_IN == 0
