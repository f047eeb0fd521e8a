"""Bundle adjustment of cameras and points: Levenberg-Marquardt with the Schur complement.

Minimises sum rho(|residual| / f_scale) over poses, intrinsics and points (Triggs et al., "Bundle Adjustment
- A Modern Synthesis", 2000, sections 4 and 6). Points are eliminated, so the system left has the size of the
cameras; its inverse gives their covariance with the points' uncertainty included. Intrinsics can carry
Gaussian priors (from a board calibration), which COLMAP's adjuster does not offer.

Symbols: C cameras, G devices (intrinsics shared by cameras), P points, M observations. A camera's pose moves
by a small rotation vector and a translation, both in the camera's own axes: X_cam -> exp(w) X_cam + t.
Intrinsics vectors are fx, fy, cx, cy, k1, k2, p1, p2, k3; with `one_focal`, fy moves with fx.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

Loss = str  # "linear", "soft_l1" or "cauchy"
STEP = 1e-6  # central differences of the lens model: exact to about 1e-9 relative
MAX_ITERATIONS = 30
FUNCTION_TOLERANCE = 1e-7
MIN_DEPTH = 1e-6


@dataclass(frozen=True)
class Problem:
    """Everything that is seen, where it is now, and what may move.

    Attributes:
        poses: cam_from_world [C, 3, 4].
        intrinsics: [G, 9].
        device: Device of each camera [C].
        points: [P, 3].
        obs_camera, obs_point, obs_xy: Observations [M], [M], [M, 2], pixels.
        free_pose: [C]; free_intrinsics: [G, 9]; free_points: whether points move.
        one_focal: fy keeps its ratio to fx [G].
        prior_mean, prior_std: Of the intrinsics [G, 9]; std infinite where there is no prior.
    """

    poses: Float[np.ndarray, "cameras 3 4"]
    intrinsics: Float[np.ndarray, "devices 9"]
    device: Int[np.ndarray, " cameras"]
    points: Float[np.ndarray, "points 3"]
    obs_camera: Int[np.ndarray, " observations"]
    obs_point: Int[np.ndarray, " observations"]
    obs_xy: Float[np.ndarray, "observations 2"]
    free_pose: Bool[np.ndarray, " cameras"]
    free_intrinsics: Bool[np.ndarray, "devices 9"]
    free_points: bool
    one_focal: Bool[np.ndarray, " devices"]
    prior_mean: Float[np.ndarray, "devices 9"]
    prior_std: Float[np.ndarray, "devices 9"]


@dataclass(frozen=True)
class Solution:
    """The adjusted problem.

    Attributes:
        problem: With poses, intrinsics and points moved.
        residual_px: Reprojection residuals [M, 2].
        pose_covariance: [C, 6, 6], rotation vector first, in camera axes; zero where the pose was held.
        intrinsics_std: [G, 9]; zero where held.
        cost: Robust cost; sigma_px: robust estimate of an observation's noise, per coordinate.
        iterations: Steps taken.
    """

    problem: Problem
    residual_px: Float[np.ndarray, "observations 2"]
    pose_covariance: Float[np.ndarray, "cameras 6 6"]
    intrinsics_std: Float[np.ndarray, "devices 9"]
    cost: float
    sigma_px: float
    iterations: int


def adjust(
    problem: Problem, loss: Loss = "cauchy", f_scale_px: float = 1.0, noise_px: float = 0.5
) -> Solution:
    """Minimise the robust reprojection error.

    Args:
        problem: Start values; points must lie before the cameras that see them.
        loss: `linear`, `soft_l1` or `cauchy`, as in scipy.optimize.least_squares.
        f_scale_px: Residual length at which the loss begins to bend.
        noise_px: Expected error of an observation; weighs the priors against the observations.
    Raises:
        ValueError: The problem has no observations.
    """
    if len(problem.obs_point) == 0:
        raise ValueError("bundle adjustment without observations")
    problem = replace(problem, prior_std=problem.prior_std / noise_px)
    layout = _Layout(problem)
    damping, cost, steps = 1e-4, _cost(problem, loss, f_scale_px), 0
    for _ in range(MAX_ITERATIONS):
        system = _normal_equations(problem, layout, loss, f_scale_px)
        new_cost, candidate = cost, problem
        while damping < 1e8:
            candidate = _moved(problem, layout, *_step(system, damping))
            new_cost = _cost(candidate, loss, f_scale_px)
            if new_cost < cost:
                break
            damping *= 8
        if not new_cost < cost:
            break
        steps += 1
        gain, cost, problem = cost - new_cost, new_cost, candidate
        damping = max(damping / 8, 1e-9)
        if gain < FUNCTION_TOLERANCE * cost:
            break
    residual = reprojection(problem)
    unknowns = layout.size + (problem.points.size if problem.free_points else 0)
    spare = max(residual.size - unknowns, 1)  # fitted unknowns take a part of the noise with them
    sigma = robust_sigma(residual) * float(np.sqrt(residual.size / spare))
    covariance, std = _covariances(problem, layout, loss, f_scale_px, sigma)
    problem = replace(problem, prior_std=problem.prior_std * noise_px)
    return Solution(problem, residual, covariance, std, cost, sigma, steps)


def reprojection(problem: Problem) -> Float[np.ndarray, "observations 2"]:
    """Projection minus observation of every observation [M, 2], pixels."""
    return (
        _project(problem.intrinsics[problem.device[problem.obs_camera]], _in_camera(problem)) - problem.obs_xy
    )


def robust_sigma(residual: Float[np.ndarray, "observations 2"]) -> float:
    """Scale of a residual coordinate from the median absolute value (1.4826 MAD; Huber 1981), pixels."""
    return float(1.4826 * np.median(np.abs(residual)))


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


class _Layout:
    """Which column of the camera system belongs to which parameter."""

    def __init__(self, problem: Problem) -> None:
        self.pose = np.full((len(problem.poses), 6), -1)
        self.pose[problem.free_pose] = np.arange(6 * problem.free_pose.sum()).reshape(-1, 6)
        start = 6 * int(problem.free_pose.sum())
        self.intrinsics = np.full((len(problem.intrinsics), 9), -1)
        for g, free in enumerate(problem.free_intrinsics):
            free = free.copy()
            free[1] &= not problem.one_focal[g]
            self.intrinsics[g, free] = start + np.arange(free.sum())
            start += int(free.sum())
        self.size = start


@dataclass(frozen=True)
class _System:
    U: np.ndarray  # camera block [size, size]
    W: sp.csr_matrix | None  # camera x point block [size, 3 P]
    V: np.ndarray  # point blocks [P, 3, 3]
    a: np.ndarray  # gradient of the cameras
    b: np.ndarray  # gradient of the points [P, 3]


def _in_camera(problem: Problem) -> Float[np.ndarray, "observations 3"]:
    poses = problem.poses[problem.obs_camera]
    return np.einsum("mij,mj->mi", poses[:, :, :3], problem.points[problem.obs_point]) + poses[:, :, 3]


def _project(
    intrinsics: Float[np.ndarray, "observations 9"], x: Float[np.ndarray, "observations 3"]
) -> Float[np.ndarray, "observations 2"]:
    z = np.maximum(x[:, 2:], MIN_DEPTH)
    distorted = distort_many(x[:, :2] / z, intrinsics[:, 4:])
    return distorted * intrinsics[:, :2] + intrinsics[:, 2:4]


def distort_many(
    x: Float[np.ndarray, "n 2"], distortion: Float[np.ndarray, "n 5"]
) -> Float[np.ndarray, "n 2"]:
    """`camera.distort` with one set of coefficients per point."""
    k1, k2, p1, p2, k3 = distortion.T
    u, v = x[:, 0], x[:, 1]
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    du = 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    return np.stack([u * radial + du, v * radial + dv], axis=1)


def _jacobians(problem: Problem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d pixel / d pose [M, 2, 6], d pixel / d intrinsics [M, 2, 9], d pixel / d point [M, 2, 3]."""
    k = problem.intrinsics[problem.device[problem.obs_camera]]
    x = _in_camera(problem)
    d_x = np.empty((len(x), 2, 3))
    for axis in range(3):
        h = STEP * np.maximum(np.abs(x[:, 2]), MIN_DEPTH)
        ahead, behind = x.copy(), x.copy()
        ahead[:, axis] += h
        behind[:, axis] -= h
        d_x[:, :, axis] = (_project(k, ahead) - _project(k, behind)) / (2 * h)[:, None]
    d_k = np.empty((len(x), 2, 9))
    for i in range(9):
        h = STEP * np.maximum(np.abs(k[:, i]), 1.0)
        ahead, behind = k.copy(), k.copy()
        ahead[:, i] += h
        behind[:, i] -= h
        d_k[:, :, i] = (_project(ahead, x) - _project(behind, x)) / (2 * h)[:, None]
    one = problem.one_focal[problem.device[problem.obs_camera]]
    ratio = np.where(one, k[:, 1] / k[:, 0], 0.0)
    d_k[:, :, 0] += d_k[:, :, 1] * ratio[:, None]
    minus_cross = np.zeros((len(x), 3, 3))  # d(exp(w) x)/dw = -[x]_x
    minus_cross[:, 0, 1], minus_cross[:, 0, 2] = x[:, 2], -x[:, 1]
    minus_cross[:, 1, 0], minus_cross[:, 1, 2] = -x[:, 2], x[:, 0]
    minus_cross[:, 2, 0], minus_cross[:, 2, 1] = x[:, 1], -x[:, 0]
    d_pose = np.concatenate([d_x @ minus_cross, d_x], axis=2)
    return d_pose, d_k, d_x @ problem.poses[problem.obs_camera][:, :, :3]


def _normal_equations(problem: Problem, layout: _Layout, loss: Loss, f_scale: float) -> _System:
    residual = reprojection(problem)
    weight = loss_weight((residual**2).sum(1) / f_scale**2, loss)
    d_pose, d_k, d_point = _jacobians(problem)
    root = np.sqrt(weight)[:, None]
    r, d_pose, d_k, d_point = (
        residual * root,
        d_pose * root[..., None],
        d_k * root[..., None],
        d_point * root[..., None],
    )
    columns = np.concatenate(
        [layout.pose[problem.obs_camera], layout.intrinsics[problem.device[problem.obs_camera]]], axis=1
    )
    d_camera = np.concatenate([d_pose, d_k], axis=2)
    M, size = len(r), layout.size
    used = np.repeat((columns >= 0)[:, None, :], 2, axis=1)
    rows = np.repeat(np.arange(2 * M).reshape(M, 2, 1), 15, axis=2)
    cols = np.repeat(columns[:, None, :], 2, axis=1)
    J = sp.csr_matrix((d_camera[used], (rows[used], cols[used])), shape=(2 * M, size))
    U = (J.T @ J).toarray()
    a = J.T @ r.reshape(-1)
    _add_priors(problem, layout, U, a)
    P = len(problem.points)
    if not problem.free_points:
        return _System(U, None, np.zeros((0, 3, 3)), a, np.zeros((0, 3)))
    V = np.zeros((P, 3, 3))
    np.add.at(V, problem.obs_point, np.einsum("mri,mrj->mij", d_point, d_point))
    b = np.zeros((P, 3))
    np.add.at(b, problem.obs_point, np.einsum("mri,mr->mi", d_point, r))
    point_columns = np.repeat((3 * problem.obs_point[:, None] + np.arange(3))[:, None, :], 2, axis=1)
    B = sp.csr_matrix(
        (d_point.reshape(-1), (np.repeat(np.arange(2 * M), 3), point_columns.reshape(-1))),
        shape=(2 * M, 3 * P),
    )
    return _System(U, (J.T @ B).tocsr(), V, a, b)


def _add_priors(problem: Problem, layout: _Layout, U: np.ndarray, a: np.ndarray) -> None:
    for g, i in zip(*np.nonzero(np.isfinite(problem.prior_std) & (layout.intrinsics >= 0)), strict=True):
        column, precision = layout.intrinsics[g, i], 1 / problem.prior_std[g, i] ** 2
        U[column, column] += precision
        a[column] += precision * (problem.intrinsics[g, i] - problem.prior_mean[g, i])


def _step(system: _System, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Solve the damped system for the step of the cameras and of the points."""
    S, V_inv = _schur(system, damping)
    rhs = -system.a
    if system.W is not None:
        rhs = rhs + system.W @ np.einsum("pij,pj->pi", V_inv, system.b).reshape(-1)
    camera = np.linalg.lstsq(S, rhs, rcond=None)[0] if len(S) else np.zeros(0)
    if system.W is None:
        return camera, np.zeros((0, 3))
    right = -(system.b + (system.W.T @ camera).reshape(-1, 3))
    return camera, np.einsum("pij,pj->pi", V_inv, right)


def _schur(system: _System, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """S = U - W V^-1 W^T, and V^-1, with Marquardt's scaled damping."""
    S = system.U + damping * np.diag(np.diag(system.U))
    if system.W is None:
        return S, system.V
    diagonal = np.einsum("pii->pi", system.V)
    V = system.V + (damping * diagonal + 1e-12 * diagonal.max(initial=1.0))[:, :, None] * np.eye(3)
    V_inv = np.linalg.inv(V)
    blocks = sp.bsr_matrix((V_inv, np.arange(len(V)), np.arange(len(V) + 1)), shape=(3 * len(V), 3 * len(V)))
    return S - (system.W @ blocks @ system.W.T).toarray(), V_inv


def _moved(problem: Problem, layout: _Layout, camera: np.ndarray, point: np.ndarray) -> Problem:
    poses = problem.poses.copy()
    for c in np.flatnonzero(problem.free_pose):
        delta = camera[layout.pose[c]]
        R = cv2.Rodrigues(delta[:3])[0]
        poses[c] = R @ poses[c]
        poses[c, :, 3] += delta[3:]
    intrinsics = problem.intrinsics.copy()
    step = np.where(layout.intrinsics >= 0, np.append(camera, 0.0)[layout.intrinsics], 0.0)
    ratio = intrinsics[:, 1] / intrinsics[:, 0]
    intrinsics += step
    intrinsics[problem.one_focal, 1] = (ratio * intrinsics[:, 0])[problem.one_focal]
    points = problem.points + point if problem.free_points else problem.points
    return replace(problem, poses=poses, intrinsics=intrinsics, points=points)


def _cost(problem: Problem, loss: Loss, f_scale: float) -> float:
    squared = (reprojection(problem) ** 2).sum(1) / f_scale**2
    deviation = (problem.intrinsics - problem.prior_mean) / problem.prior_std
    prior = float((np.where(np.isfinite(problem.prior_std), deviation, 0.0) ** 2).sum())
    return f_scale**2 * float(loss_value(squared, loss).sum()) + prior


def _covariances(
    problem: Problem, layout: _Layout, loss: Loss, f_scale: float, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    poses, std = np.zeros((len(problem.poses), 6, 6)), np.zeros((len(problem.intrinsics), 9))
    if layout.size == 0:
        return poses, std
    S, _ = _schur(_normal_equations(problem, layout, loss, f_scale), 0.0)
    covariance = np.linalg.pinv(S, hermitian=True) * max(sigma, 1e-12) ** 2
    for c in np.flatnonzero(problem.free_pose):
        poses[c] = covariance[np.ix_(layout.pose[c], layout.pose[c])]
    diagonal = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    std = np.where(layout.intrinsics >= 0, np.append(diagonal, 0.0)[layout.intrinsics], 0.0)
    std[problem.one_focal, 1] = std[problem.one_focal, 0]
    return poses, std
