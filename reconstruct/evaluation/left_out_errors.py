"""How well a model explains what moves, by pixels that training leaves out, and whether another does better.

Pictures of one camera at neighbouring moments are alike, so a hundred of them are far fewer than a hundred
measurements: one model does better than another where the interval of its mean gain (`paired.gain_within_clips`) lies
above 0.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from devrf.reconstruct.evaluation.left_out import LeftOut
from devrf.reconstruct.evaluation.paired import Gain, gain_within_clips
from devrf.reconstruct.rendering.model import DynamicModel, RayColours, Rendered
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.moving_pictures import MovingPictures

AT_ONCE = 1 << 13  # rays
LEAST = 1e-12  # of a squared error: a picture that is met exactly has a PSNR, too


@dataclass(frozen=True)
class Errors:
    """Squared errors of pixels left out of training, by picture.

    Attributes:
        pictures: Camera and number in its clip.
        time: In [0, 1].
        mse: Mean over pixels and colours, of colours in [0, 1].
        pixels: How many were asked.
    """

    pictures: tuple[tuple[str, int], ...]
    time: Float[np.ndarray, " f"]
    mse: Float[np.ndarray, " f"]
    pixels: Int[np.ndarray, " f"]

    @staticmethod
    def of(rays: RaySet, asked: Int[torch.Tensor, " n"], squared: Float[torch.Tensor, " n"]) -> "Errors":
        """Of the pictures of rays that were asked, and the squared errors of these rays."""
        frame = asked.cpu().numpy()
        total = np.bincount(frame, squared.cpu().numpy(), len(rays))
        pixels = np.bincount(frame, minlength=len(rays))
        there = np.flatnonzero(pixels)
        return Errors(
            tuple((rays.frames[n].camera_name, rays.frames[n].index) for n in there.tolist()),
            rays.times.cpu().numpy()[there].astype(float),
            np.maximum(total[there] / pixels[there], LEAST),
            pixels[there],
        )

    @property
    def mean(self) -> float:
        """Mean squared error of all pixels."""
        return float(np.average(self.mse, weights=self.pixels))

    def gain_db(self, other: "Errors") -> float:
        """By how many dB the mean squared error of all pixels is smaller than another's."""
        return 10 * math.log10(other.mean / self.mean)

    def gain_over(self, other: "Errors") -> Gain:
        """By how many dB pictures are explained better than by another, with its interval; of those of both.

        Raises:
            ValueError: They have no picture in common.
        """
        place = {picture: n for n, picture in enumerate(other.pictures)}
        mine = [n for n, picture in enumerate(self.pictures) if picture in place]
        theirs = [place[self.pictures[n]] for n in mine]
        if not mine:
            raise ValueError("errors of no picture in common cannot be compared")
        two = (-10 * np.log10(mse) for mse in (self.mse[mine], other.mse[theirs]))
        with_it, without = (psnr.tolist() for psnr in two)
        cameras = [self.pictures[n][0] for n in mine]
        return gain_within_clips(with_it, without, cameras, other.time[theirs].tolist())


def errors_in_motion(pictures: MovingPictures, model: DynamicModel) -> Errors:
    """Errors of a model of motion that was trained on these pictures, pixels left out."""
    rays = pictures.rays
    left_out = LeftOut(rays, pictures.changing)
    return errors_of(
        rays, left_out, pictures.around, lambda some: model.box_at(some.rays_o, some.rays_d, some.time)
    )


@torch.no_grad()
def errors_of(
    rays: RaySet,
    left_out: LeftOut,
    around: PixelSurroundings,
    box: Callable[[RayBatch], Rendered | RayColours],
) -> Errors:
    """Errors of the pictures that `left_out` asks.

    Args:
        rays: The training pictures.
        left_out: Pixels of these.
        around: What their pixels see beside the box.
        box: What rays see in it.
    """
    batch, squared = left_out.rays_of(left_out.asked()), []
    assert batch is not None
    for frame, pixel in zip(batch.frame.split(AT_ONCE), batch.pixel.split(AT_ONCE), strict=True):
        some = rays.at(frame, pixel)
        seen = box(some)
        drawn = around.at(frame, pixel).compose(seen.rgb, seen.left)
        squared.append(((drawn - some.rgb).double() ** 2).mean(1))
    return Errors.of(rays, batch.frame, torch.cat(squared))
