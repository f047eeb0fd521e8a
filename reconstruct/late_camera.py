"""A camera whose clock is wrong by about two pictures, and sure of itself: found by the motion that the others see.

Once the motion is trained on all cameras, each one's pictures are rendered a little earlier and later. The motion has
followed the wrong camera part of the way, so how far off it is cannot be read there, but that it differs from all
others can. It is then left out of a training of the coarsest level: what the others see move tells when its pictures
were taken. Its clock is moved only if its pictures fit clearly better so, and the motion is trained anew. The first
camera stays, whose clock is everyone's.
"""

from collections.abc import Mapping
from dataclasses import replace
from statistics import median

import numpy as np
import torch
from jaxtyping import Float

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.clocks import error_curves, lowest, picture_gap_s, with_offset
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.moving_pixels import ChangingPixels, changing_pixels
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.pictures import clips, spread
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.surroundings import PixelSurroundings

FEWEST = 3  # cameras: of two nobody knows which one is wrong
SUSPECT = 0.3  # pictures that a camera differs from the median of all: the motion follows it more than half of the way
WIDE = np.linspace(-3.0, 3.0, 25)  # pictures by which a camera that was left out is tried to be early or late
TIMES_APART = 1e-3  # of all modelled time, that a picture may lie beyond it
FEWEST_PICTURES = 4  # that can be compared at two times
SIGMAS = 4.0  # of the mean gain of a picture, for a clock to be moved: the best of many shifts is no chance
LEAST_GAIN = 0.1  # of the error, too: a few pictures may agree by chance
KEPT_SIGMAS = 2.0  # of the mean gain of a picture, for the second motion to be kept
MOST_PICTURES = 30  # of a camera, that are asked


Errors = Mapping[str, Float[np.ndarray, "F shifts"]]
"""By camera: squared errors of some of its pictures, each as if taken so many pictures later; NaN beyond the motion."""


class Moments:
    """Pictures of the training cameras, and how to ask when they fit a motion best.

    Each camera's are read once; they go with the object.
    """

    def __init__(self, scene: Scene, rest: RestModel, options: MotionOptions, device: str) -> None:
        o = options
        looked_at = rest.canonical.seen_with(o.stepsize, o.alpha_threshold, o.weight_threshold)
        self._scene = scene.in_box_frame()
        self._clips = clips(self._scene)
        self._rest, self._seed, self._device = replace(rest, canonical=looked_at), options.seed, device
        self._read: dict[str, tuple[RaySet, PixelSurroundings, ChangingPixels]] = {}

    def curves(
        self, model: DynamicModel, camera: str, shifts: Float[np.ndarray, " shifts"]
    ) -> Float[np.ndarray, "F shifts"]:
        """Errors of a camera's pictures; always of the same pixels."""
        if camera not in self._read:
            frames = tuple(spread(self._clips[camera], MOST_PICTURES))
            rays = RaySet(frames, self._scene.image_scale, self._scene.background, self._device)
            self._read[camera] = (
                rays,
                PixelSurroundings(DynamicModel(self._rest), rays),
                changing_pixels(rays),
            )
        rays, around, changing = self._read[camera]
        gap = picture_gap_s(self._clips[camera]) / (self._scene.t1_s - self._scene.t0_s)
        times = rays.times[:, None] + gap * torch.from_numpy(shifts).to(rays.times)
        generator = torch.Generator().manual_seed(self._seed)
        looked_at = replace(model, rest=self._rest)
        return error_curves(looked_at, rays, around, changing, times, generator)


def suspect(curves: Errors, reference: str) -> str | None:
    """The camera that differs most from the median of all in when its pictures fit best; None: none by enough.

    Args:
        curves: At SHIFTS.
        reference: The camera whose clock is everyone's.
    """
    shifts = {}
    for name, errors in curves.items():
        shift, std = lowest(errors[np.isfinite(errors).all(1)])
        if np.isfinite(std):
            shifts[name] = shift
    others = [name for name in shifts if name != reference]
    if len(shifts) < FEWEST or not others:
        return None
    middle = median(shifts.values())
    worst = max(others, key=lambda name: abs(shifts[name] - middle))
    return worst if abs(shifts[worst] - middle) > SUSPECT else None


def offset_pictures(curves: Float[np.ndarray, "F shifts"], shifts: Float[np.ndarray, " shifts"]) -> float:
    """By how many pictures a camera is early; 0 where its pictures do not fit clearly better at another time."""
    known = np.isfinite(curves)
    usual = np.nanmean(np.where(known.any(1, keepdims=True), curves, 1.0), axis=1, keepdims=True)
    counted = known.sum(0) >= FEWEST_PICTURES
    mean = np.where(counted, np.nansum(curves / usual, axis=0) / np.maximum(known.sum(0), 1), np.inf)
    best, now = int(np.argmin(mean)), int(np.argmin(np.abs(shifts)))
    both = known[:, best] & known[:, now]
    if best == now or both.sum() < FEWEST_PICTURES:
        return 0.0
    gain = ((curves[:, now] - curves[:, best]) / usual[:, 0])[both]
    if gain.mean() <= max(LEAST_GAIN, SIGMAS * gain.std(ddof=1) / np.sqrt(len(gain))):
        return 0.0
    return float(shifts[best])


def moved_by(scene: Scene, camera: str, offset_s: float) -> Scene:
    """The scene with a camera's training pictures at their other times, less those beyond the motion."""
    span_s = scene.t1_s - scene.t0_s

    def inside(frame: PosedFrame) -> bool:
        mine = frame.split == "train" and frame.camera_name == camera and frame.time is not None
        return not mine or -TIMES_APART <= (frame.time or 0.0) + offset_s / span_s <= 1 + TIMES_APART

    kept = replace(scene, dynamic=tuple(f for f in scene.dynamic if inside(f)))
    return with_offset(kept, camera, offset_s)


def without(scene: Scene, camera: str) -> Scene:
    """The scene without the training pictures of a camera."""
    return replace(
        scene, dynamic=tuple(f for f in scene.dynamic if f.split != "train" or f.camera_name != camera)
    )


def fits_better(before: Errors, after: Errors) -> bool:
    """Whether the pictures of all cameras, those that both motions reach, fit the second one better: no chance."""
    gain = np.concatenate([np.ravel(before[name] - after[name]) for name in before])
    gain = gain[np.isfinite(gain)]
    if len(gain) < FEWEST_PICTURES:
        return False
    return bool(gain.mean() > KEPT_SIGMAS * gain.std(ddof=1) / np.sqrt(len(gain)))
