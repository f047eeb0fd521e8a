"""What a finished sweep model says of its own faults: residuals with a pattern, lenses beyond their model, a flat
scene, a loop that did not close.

Measures only; how much is too much says the table of `pipelines/health`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import sparse

from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.camera import Camera

FEWEST_OBSERVATIONS = 40  # of a picture, for a fit of 13 numbers to its residuals
SURE_FOCAL = 0.02  # standard deviation of a picture's own focal, relative; others have no say
TWO_PEAKS_APART = 4.0  # gap between two groups over the scatter within them
FEWEST_OF_A_ZOOM = 3  # pictures
FLAT = 0.01  # of the distance: relief that moves a focal length by less than other errors do
NEAR = 0.25  # centres nearer than this share of the depth see the same things, ...
SAME_WAY_DEG = 20.0  # ... if they look the same way
NOT_NEIGHBOURS = 0.25  # of the sweep; pictures further apart in time close a loop
PLANE_TRIALS = 200  # triplets; half the points on a plane are found by the 30th


@dataclass(frozen=True)
class TwoZooms:
    """Pictures of one camera whose own focal lengths fall into two groups: the shorter and the longer."""

    ratio: float
    short: tuple[str, ...]
    long: tuple[str, ...]


@dataclass(frozen=True)
class PictureFits:
    """Linear fits to each picture's residuals, everything else held.

    Attributes:
        focal: Relative change of focal length that suits the picture (with its pose free) [N]; NaN: too few points.
        focal_std: Its standard deviation [N].
        rows_px: Size of the residuals that a pose drifting from the first row to the last explains beyond
            chance, root mean square over all pictures.
    """

    focal: Float[np.ndarray, " n"]
    focal_std: Float[np.ndarray, " n"]
    rows_px: float


def picture_fits(model: SweepModel) -> PictureFits:
    """Fit focal length, and drift along rows, to every picture's residuals."""
    n = len(model.cameras)
    focal, focal_std = np.full(n, np.nan), np.full(n, np.nan)
    rows = observations = 0.0
    order = np.argsort(model.obs_image, kind="stable")
    ends = np.searchsorted(model.obs_image[order], np.arange(n + 1))
    for i, camera in enumerate(model.cameras):
        mine = order[ends[i] : ends[i + 1]]
        points = model.xyz[model.obs_point[mine]]
        residual = model.obs_xy[mine] - camera.project(points)
        good = np.isfinite(residual).all(axis=1)
        if good.sum() < FEWEST_OBSERVATIONS:
            continue
        residual, points, xy = residual[good], points[good], model.obs_xy[mine][good]
        pose, zoom = _derivatives(camera, points)
        weight = 1 / np.sqrt(np.maximum(1.0, np.linalg.norm(residual, axis=1)))[:, None]
        r = (weight * residual).ravel()
        base = _columns(weight, pose)
        solution, std = _with_std(np.column_stack([base, _columns(weight, zoom[..., None])]), r)
        focal[i], focal_std[i] = solution[-1], std[-1]
        down = xy[:, 1, None, None] / camera.height - 0.5
        drifting = np.column_stack([base, _columns(weight, pose * down)])
        after = _fit(drifting, r)[1]
        by_chance = 6 * after / max(1, len(r) - drifting.shape[1])  # six more unknowns fit some of the noise
        rows += _fit(base, r)[1] - after - by_chance
        observations += len(xy)
    return PictureFits(focal, focal_std, float(np.sqrt(max(0.0, rows) / max(1.0, observations))))


def two_zooms(model: SweepModel, fits: PictureFits, apart: float) -> TwoZooms | None:
    """Whether one camera's pictures want two focal lengths, relative distance at least `apart`."""
    lens = [camera.lens for camera in model.cameras]
    for one in dict.fromkeys(lens):
        sure = [i for i in range(len(lens)) if lens[i] == one and fits.focal_std[i] < SURE_FOCAL]
        sure.sort(key=lambda i: fits.focal[i])
        values = fits.focal[sure]
        cuts = range(FEWEST_OF_A_ZOOM, len(sure) - FEWEST_OF_A_ZOOM + 1)
        within = {k: _scatter(values[:k]) + _scatter(values[k:]) for k in cuts}
        if not within:
            continue
        cut = min(within, key=lambda k: within[k])
        scatter = np.sqrt(within[cut] / len(values))
        low, high = float(np.median(values[:cut])), float(np.median(values[cut:]))
        gap = float(values[cut] - values[cut - 1])
        if high - low > apart and gap > TWO_PEAKS_APART * scatter:
            short, long = (tuple(sorted(model.names[i] for i in part)) for part in (sure[:cut], sure[cut:]))
            return TwoZooms(float(np.exp(high - low)), short, long)
    return None


def fold(camera: Camera) -> float:
    """Where the lens model stops being one-to-one: image radius over the corner's; infinite where nowhere.

    A Brown-Conrady polynomial with large coefficients turns back: two directions meet in one pixel there.
    """
    if camera.model != "OPENCV":
        return float("inf")
    k1, k2, _, _, k3 = camera.distortion
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0]) if np.any(camera.distortion) else np.zeros(0)
    squares = [root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    if not squares:
        return float("inf")
    r2 = min(squares)
    turning = np.sqrt(r2) * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))
    return float(turning / _corner(camera))


def field_of_view_deg(camera: Camera) -> float:
    """Across the longer side, by the focal length alone."""
    side = 0 if camera.width >= camera.height else 1
    return float(np.degrees(2 * np.arctan(max(camera.width, camera.height) / 2 / camera.K[side, side])))


def oblong(camera: Camera, pixel_aspect: float) -> float:
    """By how much focal lengths across and down differ, relative, beyond a pixel's width over its height."""
    ratio = camera.K[1, 1] / (camera.K[0, 0] * pixel_aspect)
    return float(max(ratio, 1 / ratio) - 1)


def principal_point_off(camera: Camera) -> float:
    """Largest distance of the principal point from the middle, over the width."""
    off = np.abs(camera.K[:2, 2] - [camera.width / 2, camera.height / 2])
    return float(off.max() / camera.width)


def plane_share(model: SweepModel) -> float:
    """Share of the points that lie on one plane, as far as the nearest camera can tell (least median of squares)."""
    centres = np.array([camera.centre for camera in model.cameras])
    xyz = model.xyz[model.error_px < np.inf]
    if len(xyz) < 4:
        return 0.0
    depth = float(np.median(np.linalg.norm(xyz[:, None] - centres.mean(0), axis=-1)))
    rng = np.random.default_rng(0)
    best = 0.0
    for _ in range(PLANE_TRIALS):
        a, b, c = xyz[rng.choice(len(xyz), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length > 0:
            best = max(best, float((np.abs((xyz - a) @ (normal / length)) < FLAT * depth).mean()))
    return best


def open_loop(model: SweepModel) -> tuple[float, tuple[str, str]] | None:
    """Pictures taken far apart in time, near each other, looking the same way: which share of such pairs has points
    in common, and the first pair that has none. None where the path never comes back.
    """
    n = len(model.names)
    centres = np.array([c.centre for c in model.cameras])
    forward = np.array([c.cam_from_world[2, :3] for c in model.cameras])
    ones = np.ones(len(model.obs_point))
    shape = (n, len(model.xyz))
    seen = sparse.coo_matrix((ones, (model.obs_image, model.obs_point)), shape=shape).tocsr()
    common = (seen @ seen.T).toarray()
    along = np.einsum(
        "ij,ij->i", model.xyz[model.obs_point] - centres[model.obs_image], forward[model.obs_image]
    )
    depth = np.array([np.median(along[model.obs_image == i]) if common[i, i] else 0.0 for i in range(n)])
    a, b = np.triu_indices(n, max(2, int(NOT_NEIGHBOURS * n)))
    near = np.linalg.norm(centres[a] - centres[b], axis=1) < NEAR * np.minimum(depth[a], depth[b])
    near &= np.einsum("ij,ij->i", forward[a], forward[b]) > np.cos(np.radians(SAME_WAY_DEG))
    if not near.any():
        return None
    linked = common[a, b][near] > 0
    first = int(np.flatnonzero(near)[np.argmin(linked)])
    return float(linked.mean()), (model.names[a[first]], model.names[b[first]])


def _derivatives(
    camera: Camera, points: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "m 2 6"], Float[np.ndarray, "m 2"]]:
    """Pixels by a small turn and shift of the camera, and by the logarithm of its focal length (pinhole part)."""
    X = points @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
    x, y, z = X[:, 0] / X[:, 2], X[:, 1] / X[:, 2], X[:, 2]
    zero = np.zeros_like(x)
    f = np.diag(camera.K)[:2]
    u = np.stack([-x * y, 1 + x * x, -y, 1 / z, zero, -x / z], axis=-1)
    v = np.stack([-1 - y * y, x * y, x, zero, 1 / z, -y / z], axis=-1)
    return np.stack([f[0] * u, f[1] * v], axis=1), np.stack([f[0] * x, f[1] * y], axis=-1)


def _columns(weight: np.ndarray, derivative: np.ndarray) -> np.ndarray:
    """[m, 2, k] as the matrix [2 m, k] of a weighted fit."""
    return (weight[..., None] * derivative).reshape(-1, derivative.shape[-1])


def _fit(matrix: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, float]:
    scale = np.linalg.norm(matrix, axis=0) + 1e-300  # turns and shifts have different units
    solution = np.linalg.lstsq(matrix / scale, r, rcond=1e-10)[0] / scale
    return solution, float(((r - matrix @ solution) ** 2).sum())


def _with_std(matrix: np.ndarray, r: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What fits best, and its standard deviations."""
    solution, left = _fit(matrix, r)
    covariance = np.linalg.pinv(matrix.T @ matrix) * left / max(1, len(r) - matrix.shape[1])
    return solution, np.sqrt(np.diag(covariance))


def _scatter(values: np.ndarray) -> float:
    return float(((values - np.median(values)) ** 2).sum())


def _corner(camera: Camera) -> float:
    """Image radius of the furthest corner, normalised."""
    corners = np.array([[0.0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
    return float(np.linalg.norm((corners - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=1).max())
