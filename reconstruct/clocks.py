"""Each camera's clock as an unknown of the model: offsets at which the motion fits the camera's pictures best.

Rays carry exact times and the motion field interpolates between key times, so the error of a picture is a function of
its camera's offset (Sync-NeRF, Kim et al., AAAI 2024, descends it beside the field). Between two levels of the motion
the field is held, and every camera's pictures are rendered a little before and after the times they are said to have;
the next level brings the field to the new times. A parabola through the errors is Newton's step by differences: the
exact slope has two sides at a key time, where the pictures of synchronous cameras lie, and follows fine texture
rather than the motion (measured: three such steps went a fifth of the way).

The field follows all cameras, wrong ones too, so only how much a camera differs from the reference counts, whose clock
is everyone's. What `sync` says of the clocks is a Gaussian prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.model import live_distance, render_moved
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.moving_pixels import ChangingPixels, draw_with_importance
from devrf.reconstruct.rays import RaySet
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.surroundings import PixelSurroundings

SHIFTS = np.linspace(-1.2, 1.2, 13)  # pictures by which a camera is tried to be early or late
NEAR = 2  # shifts on either side of the best one that its parabola goes through
RAYS = 96  # of each picture, where pictures change
FARTHEST = 2.0  # pictures that a clock may be moved in all
UNKNOWN = 0.5  # standard deviation, pictures, of a clock that sync knows nothing about
LEAST_STD_S = 1e-6  # of clocks that are said to be exact, so that weights are finite


@dataclass(frozen=True)
class LearnedClock:
    """What was learned of a camera's clock.

    Attributes:
        offset_s: To be added to the times of its pictures.
        std_s: Standard deviation of `offset_s`, prior included; from how much single pictures differ. None before
            they were looked at.
        prior_std_s: Standard deviation of the time that it had.
    """

    offset_s: float
    std_s: float | None
    prior_std_s: float


class Clocks:
    """The clocks of all cameras that are trained on.

    Attributes:
        learned: By camera, the reference first.

    Args:
        frames: The pictures.
        stds: Standard deviations of their clocks, the reference first, seconds; None or absent: not known.
    """

    def __init__(self, frames: Sequence[PosedFrame], stds: Mapping[str, float | None]) -> None:
        names = list(dict.fromkeys(f.camera_name for f in frames))
        reference = next((name for name in stds if name in names), names[0])
        names.sort(key=lambda name: name != reference)
        self.gaps_s = np.array(
            [picture_gap_s([f for f in frames if f.camera_name == name]) for name in names]
        )
        said = [stds.get(name) for name in names]
        priors = [UNKNOWN * gap if std is None else std for gap, std in zip(self.gaps_s, said, strict=True)]
        self.learned = {
            name: LearnedClock(0.0, None, float(max(LEAST_STD_S, prior)))
            for name, prior in zip(names, priors, strict=True)
        }
        self._camera = torch.tensor([names.index(f.camera_name) for f in frames])

    def of_frames(self, per_camera: Float[np.ndarray, " n"]) -> Float[Tensor, " F"]:
        """A number of each camera, for each of its pictures."""
        return torch.from_numpy(per_camera)[self._camera]

    @property
    def offsets_s(self) -> Float[Tensor, " F"]:
        """To be added to the times of the pictures."""
        return self.of_frames(np.array([clock.offset_s for clock in self.learned.values()]))

    def update(self, curves: Float[np.ndarray, "F shifts"]) -> None:
        """Take the offsets that squared errors ask for, of pictures at SHIFTS of their times (NaN: not looked at)."""
        camera, known = self._camera.numpy(), np.isfinite(curves).all(1)
        found = [lowest(curves[known & (camera == n)]) for n in range(len(self.learned))]
        shift, std = self.gaps_s * np.array(found).T
        clocks = list(self.learned.values())
        now, prior = (np.array([getattr(c, name) for c in clocks]) for name in ("offset_s", "prior_std_s"))
        offset, offset_std = solved(shift, std, now, prior)
        offset = np.clip(offset, -FARTHEST * self.gaps_s, FARTHEST * self.gaps_s)
        self.learned = {
            name: replace(clock, offset_s=float(offset[n]), std_s=float(offset_std[n]))
            for n, (name, clock) in enumerate(self.learned.items())
        }


def with_clocks(scene: Scene, clocks: Mapping[str, LearnedClock]) -> Scene:
    """The scene with the times that its training cameras' pictures really have, held to what is modelled."""
    span_s = scene.t1_s - scene.t0_s

    def moved(frame: PosedFrame) -> PosedFrame:
        clock = clocks.get(frame.camera_name)
        if frame.split != "train" or frame.time is None or frame.time_s is None or clock is None:
            return frame
        time_s = frame.time_s + clock.offset_s
        return replace(frame, time_s=time_s, time=min(1.0, max(0.0, (time_s - scene.t0_s) / span_s)))

    return replace(scene, dynamic=tuple(moved(f) for f in scene.dynamic))


@torch.no_grad()
def error_curves(
    rest: RestModel,
    motion: MotionField,
    rays: RaySet,
    around: PixelSurroundings,
    changing: ChangingPixels | None,
    times: Float[Tensor, "F shifts"],
    generator: torch.Generator,
) -> Float[np.ndarray, "F shifts"]:
    """Squared errors of pictures as if they had been taken at each of several times; NaN at times beyond the keys.

    Args:
        rest, motion: The model.
        rays: The pictures.
        around: What they see outside the box.
        changing: Where they change; only there they are looked at.
        times: Ascending, in the scene's time; NaN: not to be looked at.
        generator: Of the pixels that are looked at.
    """
    curves = np.full(times.shape, np.nan)
    taus = motion.tau(times.reshape(-1)).reshape(times.shape)
    for n, inside in enumerate((times >= motion.t_first) & (times <= motion.t_last)):
        picture = torch.tensor([n], device=rays.device)
        batch = draw_with_importance(rays, changing, RAYS, 1.0, picture, generator)
        if not bool(inside.any()):
            continue
        asked = taus[n, inside]
        first = min(int(asked[0]), motion.keys - 2)
        window = motion.window(first, max(first + 1, int(asked[-1].ceil())), rays.device)
        tau = (asked - first).to(rays.device)
        ray = torch.arange(len(batch.frame), device=rays.device).repeat(len(tau))
        seen = render_moved(
            rest,
            window,
            live_distance(rest, window, tau, 1),
            batch.rays_o[ray],
            batch.rays_d[ray],
            tau.repeat_interleave(len(batch.frame)),
            torch.full_like(batch.time, 0.5)[ray],
        )
        rgb = around.at(batch.frame[ray], batch.pixel[ray]).compose(seen.rgb, seen.left)
        errors = ((rgb - batch.rgb[ray]) ** 2).reshape(len(tau), -1).sum(1)
        curves[n, inside.cpu().numpy()] = errors.cpu().numpy()
    return curves


def lowest(curves: Float[np.ndarray, "pictures shifts"]) -> tuple[float, float]:
    """Shift at which all pictures together fit best, and its standard deviation, both in pictures.

    A parabola through the errors around the lowest one. The standard deviation is that of a sum of independent
    pictures ("sandwich": White, Econometrica 1982); infinite where there is no lowest error within SHIFTS.
    """
    if len(curves) < 2:
        return 0.0, np.inf
    best = int(np.clip(np.argmin(curves.sum(0)), NEAR, len(SHIFTS) - 1 - NEAR))
    near = slice(best - NEAR, best + NEAR + 1)
    square, linear, _ = np.polyfit(SHIFTS[near], curves[:, near].T, 2)
    if square.sum() <= 0:
        return 0.0, np.inf
    shift = float(np.clip(-linear.sum() / (2 * square.sum()), SHIFTS[0], SHIFTS[-1]))
    slopes = linear + 2 * square * shift
    return shift, float(np.sqrt((slopes**2).sum()) / (2 * square.sum()))


def solved(
    shift: Float[np.ndarray, " n"],
    std: Float[np.ndarray, " n"],
    offset: Float[np.ndarray, " n"],
    prior_std: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """New offsets of clocks and their standard deviations; the first camera is the reference, its offset stays 0.

    Every camera is `shift` (with `std`) away from the motion, which may itself be late by any g: least squares for
    g and the new offsets x with x[i] - g = offset[i] + shift[i], x[0] = 0, and the prior N(0, prior_std[i]) of x[i].
    """
    n = len(shift)
    of_g, of_x = -np.ones((n, 1)), np.eye(n)[:, 1:]
    rows = np.concatenate(
        [
            np.concatenate([of_g, of_x], axis=1) / std[:, None],
            np.concatenate([np.zeros((n - 1, 1)), of_x[1:] / prior_std[1:, None]], axis=1),
        ]
    )
    right = np.concatenate([(offset + shift) / std, np.zeros(n - 1)])
    covariance = np.linalg.pinv(rows.T @ rows)  # g is free where no camera has a say
    found = (covariance @ rows.T @ right)[1:]
    return np.concatenate([[0.0], found]), np.concatenate([[0.0], np.sqrt(np.diag(covariance)[1:])])


def picture_gap_s(frames: Sequence[PosedFrame]) -> float:
    """Time from one picture of a camera to its next."""
    times = sorted(f.time_s for f in frames if f.time_s is not None)
    return median(b - a for a, b in zip(times, times[1:], strict=False)) if len(times) > 1 else 0.0
