"""A camera whose clock is wrong by up to two pictures, and sure of itself: found by the motion that the others see.

Once the motion is trained on all cameras, each one's pictures are rendered a little earlier and later. The motion has
followed the wrong camera part of the way, so how far off it is cannot be read there, but that it differs from all
others can. It is then left out of a training of the coarsest level: what the others see move tells when its pictures
were taken. Its clock is moved only if its pictures fit clearly better so, and the motion is trained anew. The first
camera stays, whose clock is everyone's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import torch
from jaxtyping import Float

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.clocks import SHIFTS, LearnedClock, error_curves, lowest, picture_gap_s, with_clocks
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.surroundings import PixelSurroundings
from devrf.reconstruct.train_canonical import RestModel

FEWEST = 3  # cameras: of two nobody knows which one is wrong
SUSPECT = 0.3  # pictures that a camera differs from the median of all: the motion follows it more than half of the way
WIDE = np.linspace(-3.0, 3.0, 25)  # pictures by which a camera that was left out is tried to be early or late
TIMES_APART = 1e-3  # of all modelled time, that a picture may lie beyond it
FEWEST_PICTURES = 4  # that can be compared at two times
SIGMAS = 4.0  # of the mean gain of a picture, for a clock to be moved: the best of many shifts is no chance
LEAST_GAIN = 0.1  # of the error, too: a few pictures may agree by chance


@dataclass(frozen=True)
class Moments:
    """Pictures of the training cameras, and how to ask when they fit a motion best."""

    scene: Scene
    rest: RestModel
    options: MotionOptions
    device: str

    def curves(
        self, motion: MotionField, camera: str, shifts: Float[np.ndarray, " shifts"]
    ) -> Float[np.ndarray, "F shifts"]:
        """Squared errors of a camera's pictures, each as if taken so many pictures later; NaN beyond the motion."""
        scene, o = self.scene.in_box_frame(), self.options
        frames = of_camera(scene, camera)
        rays = RaySet(frames, scene.image_scale, scene.background, self.device)
        looked_at = self.rest.canonical.seen_with(o.stepsize, o.alpha_threshold, o.weight_threshold)
        rest = replace(self.rest, canonical=looked_at)
        gap = picture_gap_s(frames) / (scene.t1_s - scene.t0_s)
        times = rays.times[:, None] + gap * torch.from_numpy(shifts).to(rays.times)
        generator = torch.Generator().manual_seed(o.seed)
        around = PixelSurroundings(DynamicModel(rest), rays)
        return error_curves(rest, motion, rays, around, changing_pixels(rays), times, generator)


def suspect(moments: Moments, motion: MotionField, reference: str) -> str | None:
    """The camera that differs most from the median of all in when its pictures fit best; None: none by enough."""
    names = cameras_of(moments.scene)
    if len(names) < FEWEST:
        return None
    shifts = {}
    for name in names:
        curves = moments.curves(motion, name, SHIFTS)
        shift, std = lowest(curves[np.isfinite(curves).all(1)])
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
    return with_clocks(kept, {camera: LearnedClock(offset_s, None, 0.0)})


def without(scene: Scene, camera: str) -> Scene:
    """The scene without the training pictures of a camera."""
    return replace(
        scene, dynamic=tuple(f for f in scene.dynamic if f.split != "train" or f.camera_name != camera)
    )


def of_camera(scene: Scene, camera: str) -> tuple[PosedFrame, ...]:
    """The training pictures of a camera."""
    return tuple(
        f for f in scene.dynamic if f.split == "train" and f.time is not None and f.camera_name == camera
    )


def cameras_of(scene: Scene) -> Sequence[str]:
    """Names of the training cameras."""
    return tuple(dict.fromkeys(f.camera_name for f in scene.dynamic if f.split == "train"))


def fits_better(moments: Moments, before: MotionField, moved: Moments, after: MotionField) -> bool:
    """Whether the second motion, with its times, fits the pictures of all cameras better than the first."""
    now = np.zeros(1)
    errors = []
    for one, motion in ((moments, before), (moved, after)):
        curves = [one.curves(motion, name, now) for name in cameras_of(one.scene)]
        errors.append(float(np.nanmean(np.concatenate(curves))))
    return errors[1] < errors[0]
