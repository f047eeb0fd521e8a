"""Least squares of one camera and the boards it saw: Levenberg-Marquardt, the boards' poses eliminated.

Minimises sum rho(|residual|) over the intrinsics, a bow of the board and one pose per view (Zhang, PAMI 2000; Triggs
et al., "Bundle Adjustment - A Modern Synthesis", 2000, section 6), with either lens model of `capture.camera`.
The loss is Huber's. Standard deviations come in two ways, and the larger counts: from the residuals as if
every corner erred on its own, and from leaving out one view after the other (delete-one jackknife, one
Gauss-Newton step each; Efron 1982), which also holds where the corners of a view err together, as they do when
the board is blurred, bent or not where its neighbours say.

Symbols: V views, M corners; a view's pose moves by a small rotation vector and a translation in the camera's
own axes, X_cam -> exp(w) X_cam + t. Globals g [11]: fx, fy, cx, cy, the five of the distortion, and the bow: how far
the board's middle stands out along its x and along its y, in metres (a parabola, as in mrcal).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.calibration.boards.spec import BoardView
from devrf.calibration.bundle.model import minus_cross
from devrf.calibration.intrinsics import Intrinsics, from_vector
from devrf.capture.camera import LensModel, distort

GLOBALS = 11
BOW = slice(9, 11)
STEP = 1e-6  # central differences in the picture: exact to about 1e-9 relative
MAX_STEPS = 60
TOLERANCE = 1e-8  # of the cost; focal lengths of long lenses creep along a flat valley
MIN_DEPTH = 1e-6


@dataclass(frozen=True)
class Corners:
    """Everything that was seen: corners on the board, and in which view and where in the picture.

    Attributes:
        on_board: [M, 3], metres; view: [M]; xy: [M, 2], pixels.
        bulge: 1 - u^2 and 1 - v^2 [M, 2] with u, v from -1 to 1 over the board: the shape of a unit bow.
    """

    on_board: Float[np.ndarray, "m 3"]
    view: Int[np.ndarray, " m"]
    xy: Float[np.ndarray, "m 2"]
    bulge: Float[np.ndarray, "m 2"]


@dataclass(frozen=True)
class Fit:
    """A camera and its boards at the minimum.

    Attributes:
        size, model: Of the camera.
        globals: [11]; free: which of them moved [11]; one_focal: whether fy was kept equal to fx.
        poses: cam_from_board [V, 3, 4].
        residual: Projection minus observation [M, 2], pixels.
        std: Standard deviations of the globals [11], zero where held.
        corners: What was fitted.
    """

    size: tuple[int, int]
    model: LensModel
    globals: Float[np.ndarray, "11"]
    free: Bool[np.ndarray, "11"]
    one_focal: bool
    poses: Float[np.ndarray, "views 3 4"]
    residual: Float[np.ndarray, "m 2"]
    std: Float[np.ndarray, "11"]
    corners: Corners

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths, as OpenCV counts."""
        return float(np.sqrt((self.residual**2).sum(1).mean()))

    @property
    def view_rms_px(self) -> Float[np.ndarray, " views"]:
        """The same per view."""
        count = np.bincount(self.corners.view, minlength=len(self.poses))
        return np.sqrt(np.bincount(self.corners.view, (self.residual**2).sum(1)) / np.maximum(count, 1))

    @property
    def intrinsics(self) -> Intrinsics:
        """The camera, with standard deviations."""
        return from_vector(*self.size, self.globals[:9], self.std[:9], self.model)

    @property
    def unknowns(self) -> int:
        """Globals that moved."""
        return int(self.free.sum()) - self.one_focal


def gather(views: list[BoardView], corners: Float[np.ndarray, "corners 3"]) -> Corners:
    """The corners of all views as one list."""
    middle, half = (corners.max(0) + corners.min(0)) / 2, np.maximum(np.ptp(corners, axis=0) / 2, 1e-9)
    bulge = 1 - (((corners - middle) / half) ** 2)[:, :2]
    ids = np.concatenate([v.ids for v in views])
    number = np.repeat(np.arange(len(views)), [len(v.ids) for v in views])
    return Corners(corners[ids], number, np.concatenate([v.xy for v in views]), bulge[ids])


def board_pose(
    on_board: Float[np.ndarray, "n 3"], xy: Float[np.ndarray, "n 2"], camera: Intrinsics
) -> Float[np.ndarray, "3 4"]:
    """cam_from_board of one view (IPPE; Collins and Bartoli, IJCV 2014).

    Solved in a picture whose axis points at the board, so that it holds for fisheyes and far corners too.
    """
    rays = camera.at(np.eye(3, 4)).directions(xy)
    z = rays.mean(0) / np.linalg.norm(rays.mean(0))
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(z, x), z])
    seen = rays @ turn.T
    flat = seen[:, :2] / np.maximum(seen[:, 2:], 0.05)
    centre = on_board.mean(0)  # IPPE wants the points around the origin
    _, rotations, translations, errors = cv2.solvePnPGeneric(
        on_board - centre, flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    best = int(np.argmin(np.asarray(errors).reshape(-1)))
    R = turn.T @ cv2.Rodrigues(rotations[best])[0]
    return np.column_stack([R, turn.T @ np.asarray(translations[best]).reshape(3) - R @ centre])


def start_fit(corners: Corners, camera: Intrinsics, free: Bool[np.ndarray, "11"], one_focal: bool) -> Fit:
    """A fit that has not moved yet: poses of all views with the given camera."""
    poses = np.array(
        [
            board_pose(corners.on_board[corners.view == v], corners.xy[corners.view == v], camera)
            for v in range(int(corners.view.max()) + 1)
        ]
    )
    start = np.concatenate([camera.vector, [0.0, 0.0]])
    size = (camera.width, camera.height)
    zero, none = np.zeros_like(corners.xy), np.zeros(GLOBALS)
    fit = Fit(size, camera.model, start, free, one_focal, poses, zero, none, corners)
    return replace(fit, residual=residual(fit))


def minimise(fit: Fit, huber_px: float = np.inf) -> Fit:
    """Move to the minimum; residual coordinates beyond `huber_px` count linearly."""
    damping, value = 1e-4, cost(fit, huber_px)
    for _ in range(MAX_STEPS):
        system = _reduce(fit, huber_px)
        candidate, new_value = fit, value
        while damping < 1e10:
            candidate = _moved(fit, system, damping)
            new_value = cost(candidate, huber_px)
            if new_value < value:
                break
            damping *= 8
        if not new_value < value:
            break
        gain, fit, value = value - new_value, candidate, new_value
        damping = max(damping / 8, 1e-12)
        if gain < TOLERANCE * value:
            break
    return replace(fit, std=_std(fit, huber_px))


def residual(fit: Fit) -> Float[np.ndarray, "m 2"]:
    """Projection minus observation of every corner [M, 2], pixels."""
    return _project(fit.globals, _in_camera(fit, fit.globals), fit.model) - fit.corners.xy


def cost(fit: Fit, huber_px: float) -> float:
    """Sum of rho over the residual coordinates, pixels squared (Huber 1981)."""
    size = np.abs(fit.residual)
    if not np.isfinite(huber_px):
        return float((size**2).sum())
    return float(np.where(size < huber_px, size**2, huber_px * (2 * size - huber_px)).sum())


def of_views(fit: Fit, keep: Bool[np.ndarray, " views"]) -> Fit:
    """The fit restricted to some views, not yet moved."""
    inside = keep[fit.corners.view]
    number = np.cumsum(keep) - 1
    c = fit.corners
    corners = Corners(c.on_board[inside], number[c.view[inside]], c.xy[inside], c.bulge[inside])
    return replace(fit, corners=corners, poses=fit.poses[keep], residual=fit.residual[inside])


def coordinate_sigma(fit: Fit) -> float:
    """Noise of a residual coordinate from the median absolute value (1.4826 MAD), pixels."""
    spare = max(fit.residual.size - fit.unknowns - 6 * len(fit.poses), 1)
    return float(1.4826 * np.median(np.abs(fit.residual)) * np.sqrt(fit.residual.size / spare))


@dataclass(frozen=True)
class _System:
    """Normal equations, per view: globals, globals x pose, pose; and the gradients. `columns`: free globals."""

    columns: Int[np.ndarray, " free"]
    C: Float[np.ndarray, "views free free"]
    B: Float[np.ndarray, "views free 6"]
    A: Float[np.ndarray, "views 6 6"]
    c: Float[np.ndarray, "views free"]
    a: Float[np.ndarray, "views 6"]


def _in_camera(fit: Fit, g: Float[np.ndarray, "11"]) -> Float[np.ndarray, "m 3"]:
    board = fit.corners.on_board.copy()
    board[:, 2] += fit.corners.bulge @ g[BOW]
    pose = fit.poses[fit.corners.view]
    return np.einsum("mij,mj->mi", pose[:, :, :3], board) + pose[:, :, 3]


def _project(
    g: Float[np.ndarray, "11"], x: Float[np.ndarray, "m 3"], model: LensModel
) -> Float[np.ndarray, "m 2"]:
    ideal = x[:, :2] / np.maximum(x[:, 2:], MIN_DEPTH)
    return distort(ideal, g[4:9], model) * g[:2] + g[2:4]


def _weight(residual: Float[np.ndarray, "m 2"], huber_px: float) -> Float[np.ndarray, "m 2"]:
    return np.minimum(1.0, huber_px / np.maximum(np.abs(residual), 1e-12))


def _reduce(fit: Fit, huber_px: float) -> _System:
    g, x = fit.globals, _in_camera(fit, fit.globals)
    columns = np.flatnonzero(fit.free & ~(np.arange(GLOBALS) == (1 if fit.one_focal else -1)))
    z = np.maximum(x[:, 2:], MIN_DEPTH)
    ideal = x[:, :2] / z
    distorted = distort(ideal, g[4:9], fit.model)
    bend = np.empty((len(x), 2, 2))  # d distorted / d ideal
    for axis in range(2):
        h = STEP * np.eye(2)[axis]
        ahead, behind = distort(ideal + h, g[4:9], fit.model), distort(ideal - h, g[4:9], fit.model)
        bend[:, :, axis] = (ahead - behind) / (2 * STEP)
    d_ideal = np.zeros((len(x), 2, 3))  # d ideal / d x
    d_ideal[:, 0, 0] = d_ideal[:, 1, 1] = 1 / z[:, 0]
    d_ideal[:, :, 2] = -ideal / z
    d_x = g[:2, None] * (bend @ d_ideal)
    every = np.zeros((len(x), 2, GLOBALS))
    every[:, 0, 0], every[:, 1, 1] = distorted[:, 0], distorted[:, 1]
    every[:, 0, 2] = every[:, 1, 3] = 1.0
    for i in set(columns.tolist()) & set(range(4, 9)):  # both lens models are linear in their coefficients
        unit = (np.arange(4, 9) == i).astype(np.float64)
        every[:, :, i] = g[:2] * (distort(ideal, g[4:9] + unit, fit.model) - distorted)
    stands_out = d_x @ fit.poses[fit.corners.view][:, :, 2, None]  # along the board's normal
    every[:, :, BOW] = stands_out * fit.corners.bulge[:, None]
    if fit.one_focal:
        every[:, :, 0] += every[:, :, 1]
    d_g = every[:, :, columns]
    d_pose = np.concatenate([d_x @ minus_cross(x), d_x], axis=2)
    root = np.sqrt(_weight(fit.residual, huber_px))[:, :, None]
    d_g, d_pose, r = d_g * root, d_pose * root, fit.residual * root[:, :, 0]
    views = np.split(np.arange(len(x)), np.searchsorted(fit.corners.view, np.arange(1, len(fit.poses))))
    n = len(columns)
    C, B, A = np.zeros((len(views), n, n)), np.zeros((len(views), n, 6)), np.zeros((len(views), 6, 6))
    c, a = np.zeros((len(views), n)), np.zeros((len(views), 6))
    for v, rows in enumerate(views):
        G, P, e = d_g[rows].reshape(2 * len(rows), n), d_pose[rows].reshape(-1, 6), r[rows].reshape(-1)
        C[v], B[v], A[v], c[v], a[v] = G.T @ G, G.T @ P, P.T @ P, G.T @ e, P.T @ e
    return _System(columns, C, B, A, c, a)


def _eliminated(
    system: _System, damping: float
) -> tuple[
    Float[np.ndarray, "views free free"], Float[np.ndarray, "views free"], Float[np.ndarray, "views 6 6"]
]:
    """Each view's part of the system of the globals, of its right side, and A^-1 (Marquardt's damping)."""
    diagonal = np.einsum("vii->vi", system.A)
    A_inv = np.linalg.inv(system.A + (damping * diagonal + 1e-15 * diagonal.max())[:, :, None] * np.eye(6))
    BA = system.B @ A_inv
    S = system.C - BA @ system.B.transpose(0, 2, 1)
    return S, system.c - np.einsum("vij,vj->vi", BA, system.a), A_inv


def _moved(fit: Fit, system: _System, damping: float) -> Fit:
    S, s, A_inv = _eliminated(system, damping)
    total = S.sum(0) + damping * np.diag(np.einsum("vii->i", system.C))
    step = -_solve(total, s.sum(0))
    moves = -np.einsum("vij,vj->vi", A_inv, system.a + np.einsum("vij,i->vj", system.B, step))
    g = fit.globals.copy()
    g[system.columns] += step
    if fit.one_focal:
        g[1] = g[0]
    poses = fit.poses.copy()
    for v, move in enumerate(moves):
        poses[v] = cv2.Rodrigues(move[:3])[0] @ poses[v]
        poses[v, :, 3] += move[3:]
    out = replace(fit, globals=g, poses=poses)
    return replace(out, residual=residual(out))


def _solve(matrix: Float[np.ndarray, "n n"], right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Least squares solution; unknowns are scaled alike first, pixels and coefficients differ by 1e4."""
    if len(right) == 0:
        return right
    scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    return scale * np.linalg.lstsq(matrix * scale * scale[:, None], right * scale, rcond=None)[0]


def _std(fit: Fit, huber_px: float) -> Float[np.ndarray, "11"]:
    """The larger of the two standard deviations; infinite where views do not determine a global."""
    system = _reduce(fit, huber_px)
    S, s, _ = _eliminated(system, 0.0)
    total, V = S.sum(0), len(fit.poses)
    out = np.zeros(GLOBALS)
    if len(system.columns) == 0:
        return out
    spare = fit.residual.size - fit.unknowns - 6 * V
    if spare < 1:
        out[system.columns] = np.inf
        return out
    weighted = _weight(fit.residual, huber_px) * fit.residual**2
    inverse = np.array([_solve(total, row) for row in np.eye(len(total))])
    variance = np.diag(inverse) * weighted.sum() / spare
    if V > 2:
        steps = np.array([_solve(total - S[v], s[v]) for v in range(V)])
        jackknife = (V - 1) / V * ((steps - steps.mean(0)) ** 2).sum(0)
        variance = np.maximum(variance, jackknife)
    out[system.columns] = np.sqrt(np.maximum(variance, 0.0))
    if fit.one_focal:
        out[1] = out[0]
    return out
