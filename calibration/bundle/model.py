"""What a bundle problem predicts: residuals and their derivatives, the robust loss.

A body's corner c is seen by camera C at X_cam = C (carry (R unit c + t) + rate dt): its place in the world,
carried along the body's way to the time of the view, the small rest dt of the time linearly. Points are bodies
with c = 0.
"""

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from devrf.calibration.bundle.problem import Problem
from devrf.capture.camera import distort_many

Loss = Literal["linear", "soft_l1", "cauchy"]
STEP = 1e-6  # central differences of the lens model: exact to about 1e-9 relative
MIN_DEPTH = 1e-6


def reprojection(problem: Problem) -> Float[np.ndarray, "observations 2"]:
    """Projection minus observation of every observation [M, 2], pixels."""
    device = problem.device[problem.obs_camera]
    x, k = _in_camera(problem, _in_world(problem)), problem.intrinsics[device]
    xy = distort_many(x[:, :2] / np.maximum(x[:, 2:], MIN_DEPTH), k[:, 4:], problem.fisheye[device])
    return xy * k[:, :2] + k[:, 2:4] - problem.obs_xy


def depths(problem: Problem) -> Float[np.ndarray, " observations"]:
    """Distance of every observation along its camera's axis [M]."""
    return _in_camera(problem, _in_world(problem))[:, 2]


def image_rate(problem: Problem) -> Float[np.ndarray, "observations 2"]:
    """How fast every observation moves in its picture [M, 2], pixels per second; 0 where nothing moves."""
    return jacobians(problem)[3]


def loss_value(squared: Float[np.ndarray, " n"], loss: Loss) -> Float[np.ndarray, " n"]:
    """rho(z) of squared, scaled residual lengths (scipy's definitions)."""
    if loss == "cauchy":
        return np.log1p(squared)
    return 2 * (np.sqrt(1 + squared) - 1) if loss == "soft_l1" else squared


def loss_weight(squared: Float[np.ndarray, " n"], loss: Loss) -> Float[np.ndarray, " n"]:
    """rho'(z), the weight of iteratively reweighted least squares."""
    if loss == "cauchy":
        return 1 / (1 + squared)
    return 1 / np.sqrt(1 + squared) if loss == "soft_l1" else np.ones_like(squared)


def jacobians(
    problem: Problem,
) -> tuple[
    Float[np.ndarray, "observations 2 6"],
    Float[np.ndarray, "observations 2 9"],
    Float[np.ndarray, "observations 2 6"],
    Float[np.ndarray, "observations 2"],
    Float[np.ndarray, "observations 2"],
]:
    """d pixel / d pose, / d intrinsics, / d body (turn, shift), / d time, / d log unit."""
    device = problem.device[problem.obs_camera]
    k, fisheye = problem.intrinsics[device], problem.fisheye[device]
    world = _in_world(problem)
    x = _in_camera(problem, world)
    d_x, d_k = _lens_jacobians(k, fisheye, x)
    one = problem.one_focal[device]
    d_k[one, :, 0] += d_k[one, :, 1] * (k[one, 1] / k[one, 0])[:, None]
    d_pose = np.concatenate([d_x @ minus_cross(x), d_x], axis=2)
    d_world = d_x @ problem.poses[problem.obs_camera][:, :, :3]
    arm = _arm(problem)
    timing = problem.timing
    if timing is None:
        d_here, d_time = d_world, np.zeros((len(x), 2))
    else:
        rest_s = timing.rest_s(problem.obs_camera)[:, None, None]
        turning = np.eye(3) - rest_s * minus_cross(timing.spin[timing.view])
        d_here = d_world @ turning @ timing.carry[timing.view][:, :, :3]
        d_time = np.einsum("mri,mi->mr", d_world, timing.rate(_carried(problem)))
    d_body = np.concatenate([d_here @ minus_cross(arm), d_here], axis=2)
    return d_pose, d_k, d_body, d_time, np.einsum("mri,mi->mr", d_here, arm)


def _arm(problem: Problem) -> Float[np.ndarray, "observations 3"]:
    """From a body's origin to its corner, in world axes."""
    rotation = problem.bodies[problem.obs_body][:, :, :3]
    return problem.unit * np.einsum("mij,mj->mi", rotation, problem.obs_local)


def _in_world(problem: Problem) -> Float[np.ndarray, "observations 3"]:
    """Every observed place in the world at the time of its view."""
    x, timing = _carried(problem), problem.timing
    if timing is None:
        return x
    return x + timing.rate(x) * timing.rest_s(problem.obs_camera)[:, None]


def _carried(problem: Problem) -> Float[np.ndarray, "observations 3"]:
    """Every observed place where its body was carried to."""
    x, timing = _arm(problem) + problem.bodies[problem.obs_body][:, :, 3], problem.timing
    if timing is None:
        return x
    carry = timing.carry[timing.view]
    return np.einsum("mij,mj->mi", carry[:, :, :3], x) + carry[:, :, 3]


def _in_camera(
    problem: Problem, world: Float[np.ndarray, "observations 3"]
) -> Float[np.ndarray, "observations 3"]:
    pose = problem.poses[problem.obs_camera]
    return np.einsum("mij,mj->mi", pose[:, :, :3], world) + pose[:, :, 3]


def _lens_jacobians(
    k: Float[np.ndarray, "n 9"], fisheye: Bool[np.ndarray, " n"], x: Float[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, "n 2 3"], Float[np.ndarray, "n 2 9"]]:
    """d pixel / d place in the camera, / d intrinsics; of the distortion by central differences."""
    z = np.maximum(x[:, 2], MIN_DEPTH)
    ideal, focal = x[:, :2] / z[:, None], k[:, :2]

    def difference(ahead: np.ndarray, behind: np.ndarray) -> np.ndarray:
        return (
            distort_many(ahead[:, :2], ahead[:, 2:], fisheye)
            - distort_many(behind[:, :2], behind[:, 2:], fisheye)
        ) / (2 * STEP)

    start = np.concatenate([ideal, k[:, 4:]], axis=1)
    d = np.empty((len(x), 2, 7))
    for i in range(7):
        shift = np.zeros(7)
        shift[i] = STEP
        d[:, :, i] = difference(start + shift, start - shift) * focal
    d_x = np.empty((len(x), 2, 3))
    d_x[:, :, :2] = d[:, :, :2] / z[:, None, None]
    d_x[:, :, 2] = -np.einsum("mri,mi->mr", d[:, :, :2], ideal) / z[:, None]
    d_k = np.zeros((len(x), 2, 9))
    distorted = distort_many(ideal, k[:, 4:], fisheye)
    d_k[:, 0, 0], d_k[:, 1, 1] = distorted.T
    d_k[:, 0, 2] = d_k[:, 1, 3] = 1.0
    d_k[:, :, 4:] = d[:, :, 2:]
    return d_x, d_k


def minus_cross(x: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """-[x]_x, the derivative of exp(w) x by w at 0."""
    out = np.zeros((len(x), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = x[:, 2], -x[:, 1]
    out[:, 1, 0], out[:, 1, 2] = -x[:, 2], x[:, 0]
    out[:, 2, 0], out[:, 2, 1] = x[:, 1], -x[:, 0]
    return out
