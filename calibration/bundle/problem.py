"""What a bundle adjustment is given: cameras, what they see, and what is known of both.

Symbols, as in `adjust.py`: C cameras, G devices (intrinsics shared by cameras), B bodies, V views, M
observations.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.calibration.intrinsics import Intrinsics


@dataclass(frozen=True)
class ViewTiming:
    """How bodies move while free-running cameras take their pictures. A view is one picture of one body.

    Attributes:
        view: View of each observation [M].
        carry: Where each view's body has moved to by the view's time [V, 3, 4], in the world.
        carried_s: The time (lag, and delay of the camera) for which `carry` was computed [V].
        spin, velocity: A place x of the view's body moves by cross(spin, x) + velocity [V, 3], 1/s, units/s.
        delay_s: Of each camera's clock [C]; delay_std_s: prior about 0; free_delay: [C].
        lag_s: Of each view [V]; lag_std_s: prior about 0; lags are held where it is 0.
    """

    view: Int[np.ndarray, " observations"]
    carry: Float[np.ndarray, "views 3 4"]
    carried_s: Float[np.ndarray, " views"]
    spin: Float[np.ndarray, "views 3"]
    velocity: Float[np.ndarray, "views 3"]
    delay_s: Float[np.ndarray, " cameras"]
    delay_std_s: float
    free_delay: Bool[np.ndarray, " cameras"]
    lag_s: Float[np.ndarray, " views"]
    lag_std_s: float

    def rest_s(self, camera: Int[np.ndarray, " observations"]) -> Float[np.ndarray, " observations"]:
        """Time of every observation after that for which its body was carried."""
        return self.delay_s[camera] + (self.lag_s - self.carried_s)[self.view]

    def rate(self, world: Float[np.ndarray, "observations 3"]) -> Float[np.ndarray, "observations 3"]:
        """Velocity of every observed place, units/s."""
        return np.cross(self.spin[self.view], world) + self.velocity[self.view]


@dataclass(frozen=True)
class Problem:
    """Everything that is seen, where it is now, and what may move.

    Attributes:
        poses: cam_from_world [C, 3, 4]; free_pose: [C].
        device: Device of each camera [C].
        intrinsics: [G, 9]; fisheye: [G]; free_intrinsics: [G, 9]; one_focal: fy keeps its ratio to fx [G].
        prior_mean, prior_std: Of the intrinsics [G, 9]; std infinite where there is no prior.
        firm_prior: Whether observations that contradict a device's prior must not weaken it [G].
        bodies: world_from_body [B, 3, 4]; freedom: 0 held, 3 may shift, 6 may turn too [B].
        obs_camera, obs_body, obs_local, obs_xy: Observations [M], [M], [M, 3] (place on the body), [M, 2] pixels.
        obs_std: Expected error of an observation [M], pixels.
        unit: World units per unit of `obs_local`; free_unit: whether it may change.
        timing: None where nothing moves.
    """

    poses: Float[np.ndarray, "cameras 3 4"]
    free_pose: Bool[np.ndarray, " cameras"]
    device: Int[np.ndarray, " cameras"]
    intrinsics: Float[np.ndarray, "devices 9"]
    fisheye: Bool[np.ndarray, " devices"]
    free_intrinsics: Bool[np.ndarray, "devices 9"]
    one_focal: Bool[np.ndarray, " devices"]
    prior_mean: Float[np.ndarray, "devices 9"]
    prior_std: Float[np.ndarray, "devices 9"]
    firm_prior: Bool[np.ndarray, " devices"]
    bodies: Float[np.ndarray, "bodies 3 4"]
    freedom: Int[np.ndarray, " bodies"]
    obs_camera: Int[np.ndarray, " observations"]
    obs_body: Int[np.ndarray, " observations"]
    obs_local: Float[np.ndarray, "observations 3"]
    obs_xy: Float[np.ndarray, "observations 2"]
    obs_std: Float[np.ndarray, " observations"]
    unit: float = 1.0
    free_unit: bool = False
    timing: ViewTiming | None = None

    @property
    def points(self) -> Float[np.ndarray, "bodies 3"]:
        """Where the bodies are."""
        return self.bodies[:, :, 3]


class Lenses(TypedDict):
    """The fields of a `Problem` that say what is known of its devices."""

    intrinsics: Float[np.ndarray, "devices 9"]
    fisheye: Bool[np.ndarray, " devices"]
    free_intrinsics: Bool[np.ndarray, "devices 9"]
    one_focal: Bool[np.ndarray, " devices"]
    prior_mean: Float[np.ndarray, "devices 9"]
    prior_std: Float[np.ndarray, "devices 9"]
    firm_prior: Bool[np.ndarray, " devices"]


class Observations(TypedDict):
    """The fields of a `Problem` that say what was seen where."""

    obs_camera: Int[np.ndarray, " observations"]
    obs_body: Int[np.ndarray, " observations"]
    obs_local: Float[np.ndarray, "observations 3"]
    obs_xy: Float[np.ndarray, "observations 2"]


def lenses(start: Sequence[Intrinsics], known: Sequence[Intrinsics]) -> Lenses:
    """Devices that start somewhere, and what is known of them.

    Args:
        start: Start values.
        known: Values and their `std`: 0 holds, infinite leaves free (a free fx takes fy along), None holds all.
    """
    std = np.array([np.zeros(9) if k.std is None else k.std for k in known])
    return Lenses(
        intrinsics=np.array([k.vector for k in start]),
        fisheye=np.array([k.model == "OPENCV_FISHEYE" for k in start]),
        free_intrinsics=std > 0,
        one_focal=~np.isfinite(std[:, 0]),
        prior_mean=np.array([k.vector for k in known]),
        prior_std=np.where(std > 0, std, np.inf),
        firm_prior=np.zeros(len(std), dtype=bool),
    )


def bodies_of_points(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 4"]:
    """Points as bodies [n, 3, 4]."""
    return np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), points[:, :, None]], axis=2)
