"""Bundle adjustment of cameras, points and boards: Levenberg-Marquardt with the Schur complement.

Minimises the sum of rho(|residual| / std) over poses, intrinsics and what is seen (Triggs et al., "Bundle
Adjustment - A Modern Synthesis", 2000, sections 4 and 6). What is seen are *bodies*: a point of the sweep is
a body that can only shift, a board at one instant is one that can turn too, its corners at known places.
Cameras run free, so pictures that count as one instant are not quite simultaneous: a camera's clock may be
slow by a `delay`, the time of a single picture by a `lag`. Bodies and lags are eliminated; the inverse of the system
left is the covariance of the cameras with the doubt of the bodies in it. Intrinsics can carry priors.

Symbols: C cameras, G devices (intrinsics shared by cameras), B bodies, V views, M observations. A pose moves
by a small rotation vector and a translation, a camera's in its own axes (X_cam -> exp(w) X_cam + t), a body's
about its origin in the world's. Intrinsics vectors are fx, fy, cx, cy and the distortion of `capture.camera`;
with `one_focal`, fy moves with fx.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int

from devrf.calibration.bundle.model import Loss, jacobians, loss_value, loss_weight, reprojection
from devrf.calibration.bundle.problem import Problem
from devrf.calibration.bundle.schur import Normal, complement, normal_equations, step

MAX_ITERATIONS = 50
FUNCTION_TOLERANCE = 1e-7
LOSS_STDS = 2.0  # residuals beyond this many standard deviations begin to lose weight
PRIOR_STDS = 3.0  # a prior that is missed by more was wrong: it too loses weight (Cauchy)
MAX_DAMPING = 1e8


@dataclass(frozen=True)
class BundleSolution:
    """The adjusted problem.

    Attributes:
        problem: With everything moved.
        residual_px: Reprojection residuals [M, 2].
        pose_covariance: [C, 6, 6], rotation vector first, in camera axes; zero where the pose was held.
        intrinsics_std: [G, 9]; zero where held.
        unit_std: Relative; delay_std_s: [C]; zero where held.
        sigma_px: Robust estimate of an observation's noise, per coordinate.
        iterations: Steps taken.
    """

    problem: Problem
    residual_px: Float[np.ndarray, "observations 2"]
    pose_covariance: Float[np.ndarray, "cameras 6 6"]
    intrinsics_std: Float[np.ndarray, "devices 9"]
    unit_std: float
    delay_std_s: Float[np.ndarray, " cameras"]
    sigma_px: float
    iterations: int


def adjust(problem: Problem, loss: Loss = "cauchy") -> BundleSolution:
    """Minimise the robust reprojection error.

    Args:
        problem: Start values; bodies must lie before the cameras that see them.
        loss: `linear`, `soft_l1` or `cauchy`, as in scipy.optimize.least_squares, with a scale of
            `LOSS_STDS` standard deviations.
    Raises:
        ValueError: The problem has no observations.
    """
    if len(problem.obs_body) == 0:
        raise ValueError("bundle adjustment without observations")
    layout = _Layout(problem)
    damping, cost, steps = 1e-4, _cost(problem, loss), 0
    for _ in range(MAX_ITERATIONS):
        normal = _normal(problem, layout, loss)[0]
        new_cost, candidate = cost, problem
        while damping < MAX_DAMPING:
            candidate = _moved(problem, layout, *step(normal, damping))
            new_cost = _cost(candidate, loss)
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
    return _solution(problem, layout, loss, steps)


def robust_sigma(residual: Float[np.ndarray, "*n"]) -> float:
    """Scale of a residual coordinate from the median absolute value (1.4826 MAD; Huber 1981)."""
    return float(1.4826 * np.median(np.abs(residual)))


class _Layout:
    """Which column belongs to which unknown. Outer: poses, intrinsics, delays, unit; inner: bodies, lags."""

    def __init__(self, problem: Problem) -> None:
        timing = problem.timing
        self.outer = self.inner = 0
        self.pose = np.full((len(problem.poses), 6), -1)
        self.pose[problem.free_pose] = self._outer(6 * int(problem.free_pose.sum())).reshape(-1, 6)
        free = problem.free_intrinsics.copy()
        free[:, 1] &= ~problem.one_focal
        self.intrinsics = np.full(free.shape, -1)
        self.intrinsics[free] = self._outer(int(free.sum()))
        self.delay = np.full(len(problem.poses), -1)
        if timing is not None:
            self.delay[timing.free_delay] = self._outer(int(timing.free_delay.sum()))
        self.unit = int(self._outer(1)[0]) if problem.free_unit else -1
        self.body = np.full((len(problem.bodies), 6), -1)
        lags = [[] for _ in problem.bodies]
        if timing is not None and timing.lag_std_s > 0:
            body_of_view = np.zeros(len(timing.lag_s), dtype=np.int64)
            body_of_view[timing.view] = problem.obs_body
            for v in np.unique(timing.view):
                lags[body_of_view[v]].append(int(v))
        self.lag = np.full(0 if timing is None else len(timing.lag_s), -1)
        sizes = np.array([f + len(own) for f, own in zip(problem.freedom, lags, strict=True)])
        blocks = []
        for size in np.unique(sizes[sizes > 0]):
            members = np.flatnonzero(sizes == size)
            columns = self.inner + np.arange(size * len(members)).reshape(-1, size)
            self.inner += columns.size
            blocks.append(columns)
            for b, own in zip(members, columns, strict=True):
                f = problem.freedom[b]
                self.body[b, 6 - f :] = own[:f]  # of a point only the last three, the shift
                self.lag[lags[b]] = own[f:]
        self.blocks = tuple(blocks)

    def _outer(self, count: int) -> Int[np.ndarray, " count"]:
        self.outer += count
        return np.arange(self.outer - count, self.outer)


def _normal(problem: Problem, layout: _Layout, loss: Loss) -> tuple[Normal, sp.csr_matrix]:
    """The normal equations, and each observation's share in the outer gradient [M, outer]."""
    weight = np.sqrt(_loss_weights(problem, loss)) / problem.obs_std
    r = reprojection(problem) * weight[:, None]
    d_pose, d_k, d_body, d_time, d_unit = (
        d * weight.reshape(-1, *[1] * (d.ndim - 1)) for d in jacobians(problem)
    )
    camera, timing = problem.obs_camera, problem.timing
    outer = [(d_pose, layout.pose[camera]), (d_k, layout.intrinsics[problem.device[camera]])]
    inner = [(d_body, layout.body[problem.obs_body])]
    if layout.unit >= 0:
        outer.append((d_unit[:, :, None], np.full((len(r), 1), layout.unit)))
    if timing is not None:
        outer.append((d_time[:, :, None], layout.delay[camera][:, None]))
        inner.append((d_time[:, :, None], layout.lag[timing.view][:, None]))
    A, B = _sparse(outer, layout.outer), _sparse(inner, layout.inner)
    prior_A, prior_B, prior_r = _priors(problem, layout)
    normal = normal_equations(
        sp.csr_matrix(sp.vstack([A, prior_A])),
        sp.csr_matrix(sp.vstack([B, prior_B])),
        np.concatenate([r.reshape(-1), prior_r]),
        layout.blocks,
    )
    pairs = sp.csr_matrix((np.ones(r.size), (np.repeat(np.arange(len(r)), 2), np.arange(r.size))))
    return normal, sp.csr_matrix(pairs @ A.multiply(r.reshape(-1, 1)))


def _sparse(parts: list[tuple[np.ndarray, np.ndarray]], size: int) -> sp.csr_matrix:
    """Jacobian [2 M, size] of parts (values [M, 2, n], columns [M, n]; column -1 is held)."""
    values = np.concatenate([v for v, _ in parts], axis=2)
    columns = np.repeat(np.concatenate([c for _, c in parts], axis=1)[:, None, :], 2, axis=1)
    rows = np.repeat(np.arange(2 * len(values)).reshape(-1, 2, 1), values.shape[2], axis=2)
    used = columns >= 0
    return sp.csr_matrix((values[used], (rows[used], columns[used])), shape=(2 * len(values), size))


def _priors(problem: Problem, layout: _Layout) -> tuple[sp.csr_matrix, sp.csr_matrix, np.ndarray]:
    """Rows of the priors on intrinsics, delays and lags: outer part, inner part, residual."""
    g, i = np.nonzero(np.isfinite(problem.prior_std) & (layout.intrinsics >= 0))
    missed = (problem.intrinsics - problem.prior_mean)[g, i] / problem.prior_std[g, i]
    weight = np.sqrt(loss_weight((missed / PRIOR_STDS) ** 2, "cauchy"))
    weight = np.where(problem.firm_prior[g], 1.0, weight)
    outer = [(layout.intrinsics[g, i], weight / problem.prior_std[g, i], weight * missed)]
    inner = []
    timing = problem.timing
    if timing is not None:
        c = np.flatnonzero(layout.delay >= 0)
        std = np.full(len(c), timing.delay_std_s)
        outer.append((layout.delay[c], 1 / std, timing.delay_s[c] / std))
        v = np.flatnonzero(layout.lag >= 0)
        std = np.full(len(v), timing.lag_std_s)
        inner.append((layout.lag[v], 1 / std, timing.lag_s[v] / std))
    parts, total = outer + inner, sum(len(columns) for columns, _, _ in outer + inner)
    matrices, start = [], 0
    for group, size in ((outer, layout.outer), (inner, layout.inner)):
        columns = np.concatenate([p[0] for p in group]) if group else np.zeros(0, dtype=np.int64)
        values = np.concatenate([p[1] for p in group]) if group else np.zeros(0)
        rows = start + np.arange(len(columns))
        matrices.append(sp.csr_matrix((values, (rows, columns)), shape=(total, size)))
        start += len(columns)
    return matrices[0], matrices[1], np.concatenate([p[2] for p in parts])


def _loss_weights(problem: Problem, loss: Loss) -> Float[np.ndarray, " observations"]:
    squared = (reprojection(problem) ** 2).sum(1) / (LOSS_STDS * problem.obs_std) ** 2
    return loss_weight(squared, loss)


def _cost(problem: Problem, loss: Loss) -> float:
    squared = (reprojection(problem) ** 2).sum(1) / (LOSS_STDS * problem.obs_std) ** 2
    used = problem.free_intrinsics & np.isfinite(problem.prior_std)
    used[:, 1] &= ~problem.one_focal
    missed = ((problem.intrinsics - problem.prior_mean)[used] / problem.prior_std[used]) ** 2
    gives_way = PRIOR_STDS**2 * loss_value(missed / PRIOR_STDS**2, "cauchy")
    cost = LOSS_STDS**2 * loss_value(squared, loss).sum()
    cost += np.where(problem.firm_prior[np.nonzero(used)[0]], missed, gives_way).sum()
    timing = problem.timing
    if timing is not None:
        cost += ((timing.delay_s / timing.delay_std_s) ** 2).sum()
        cost += ((timing.lag_s / timing.lag_std_s) ** 2).sum() if timing.lag_std_s > 0 else 0.0
    return float(cost)


def _moved(
    problem: Problem, layout: _Layout, outer: Float[np.ndarray, " outer"], inner: Float[np.ndarray, " inner"]
) -> Problem:
    outer, inner = np.append(outer, 0.0), np.append(inner, 0.0)  # column -1 does not move
    pose, body = outer[layout.pose], inner[layout.body]
    turn = _rotations(pose[:, :3])
    poses = turn @ problem.poses
    poses[:, :, 3] += pose[:, 3:]
    bodies = problem.bodies.copy()
    bodies[:, :, :3] = _rotations(body[:, :3]) @ bodies[:, :, :3]
    bodies[:, :, 3] += body[:, 3:]
    intrinsics = problem.intrinsics + outer[layout.intrinsics]
    ratio = problem.intrinsics[:, 1] / problem.intrinsics[:, 0]
    intrinsics[problem.one_focal, 1] = (ratio * intrinsics[:, 0])[problem.one_focal]
    timing = problem.timing
    if timing is not None:
        timing = replace(
            timing, delay_s=timing.delay_s + outer[layout.delay], lag_s=timing.lag_s + inner[layout.lag]
        )
    unit = problem.unit * float(np.exp(outer[layout.unit]))
    return replace(problem, poses=poses, bodies=bodies, intrinsics=intrinsics, timing=timing, unit=unit)


def _rotations(vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """exp of rotation vectors; most are zero (points do not turn)."""
    out = np.tile(np.eye(3), (len(vectors), 1, 1))
    for n in np.flatnonzero(vectors.any(axis=1)):
        out[n] = cv2.Rodrigues(vectors[n])[0]
    return out


def _solution(problem: Problem, layout: _Layout, loss: Loss, steps: int) -> BundleSolution:
    residual = reprojection(problem)
    spare = max(residual.size - layout.outer - layout.inner, 1)  # unknowns take a part of the noise with them
    freedom = float(np.sqrt(residual.size / spare))
    poses = np.zeros((len(problem.poses), 6, 6))
    std = np.zeros(1)
    if layout.outer:
        normal, shares = _normal(problem, layout, loss)
        covariance = np.linalg.pinv(complement(normal)[0], hermitian=True)
        noise = robust_sigma(residual / problem.obs_std[:, None]) * freedom
        covariance *= max(noise, 1e-12) ** 2 * _correlation(problem, shares, covariance, loss)
        for c in np.flatnonzero(problem.free_pose):
            poses[c] = covariance[np.ix_(layout.pose[c], layout.pose[c])]
        std = np.append(np.sqrt(np.maximum(np.diag(covariance), 0.0)), 0.0)
    intrinsics_std = std[layout.intrinsics]
    intrinsics_std[problem.one_focal, 1] = intrinsics_std[problem.one_focal, 0]
    return BundleSolution(
        problem=problem,
        residual_px=residual,
        pose_covariance=poses,
        intrinsics_std=intrinsics_std,
        unit_std=float(std[layout.unit]),
        delay_std_s=std[layout.delay],
        sigma_px=robust_sigma(residual) * freedom,
        iterations=steps,
    )


def _correlation(
    problem: Problem, shares: sp.csr_matrix, inverse: Float[np.ndarray, "outer outer"], loss: Loss
) -> float:
    """How much larger variances are because the corners of one body err together; at least 1.

    Mean over the unknowns of the variance that the scatter of the bodies' gradients gives, over the one that
    independent observations would have (design effect; Liang and Zeger, Biometrika 1986).
    """
    bodies = problem.obs_body
    grouped = sp.csr_matrix((np.ones(len(bodies)), (bodies, np.arange(len(bodies)))))
    by_body = sp.csr_matrix(grouped @ shares).toarray()
    together = np.einsum("ij,ji->i", inverse, by_body.T @ by_body @ inverse)
    weight = _loss_weights(problem, loss)
    squared = (reprojection(problem) ** 2).mean(1) / problem.obs_std**2
    alone = np.diag(inverse) * (weight**2 @ squared) / weight.sum()
    return max(1.0, float(np.mean(together / np.maximum(alone, 1e-300))))
