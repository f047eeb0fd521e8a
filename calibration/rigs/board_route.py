"""Fixed cameras from a board that several of them see at once: metric, and without any sweep.

One bundle adjustment over cameras, intrinsics, the board's pose at every instant, the delay of every camera's
clock and the lag of every single picture (webcams hand out pictures late, and unevenly), repeated: each round
carries the board to the times that the last round found, measures the noise again and drops the views that do
not fit (multical's rule: 5 x the 75th percentile). The world is the first camera's frame, metres.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from devrf.calibration.boards.find import BoardSpec
from devrf.calibration.bundle.adjust import BundleSolution, adjust, robust_sigma
from devrf.calibration.bundle.model import depths, image_rate
from devrf.calibration.bundle.problem import Observations, Problem, ViewTiming, lenses
from devrf.calibration.intrinsics import Intrinsics, from_vector
from devrf.calibration.rigs.board_motion import carried, still
from devrf.calibration.rigs.board_views import (
    TimedView,
    Views,
    gather,
    spanning_tree,
    start_boards,
    start_poses,
    untied,
)
from devrf.capture.camera import Camera
from devrf.capture.measure import ENOUGH_CAMERAS
from devrf.capture.system.progress import Progress, no_progress

OUTLIER_QUANTILE, OUTLIER_FACTOR = 0.75, 5.0
OUTLIER_FLOOR_PX = 0.2  # views below this are never dropped
ROUNDS = 8
SETTLED_STDS = 0.1
START_NOISE_PX, MIN_NOISE_PX = 0.5, 0.05
START_LAG_S, MIN_LAG_S = 0.01, 5e-4
TIMED_SHARE = 0.5  # a picture tells of its lag where its corners fix it to this share of the lags' spread
PRINCIPAL_POINT_STD = 0.02  # of the longer side: webcams and phones, where nothing else is known
DISTORTION_STD = np.array([0.3, 0.3, 3e-3, 3e-3, 0.3])  # k1, k2, p1, p2, k3 of consumer lenses
MIN_DEPTH_RATIO = 2.0  # caliscope: below, the board does not say enough against a calibrated focal length
DEPTH_QUANTILES = 0.02, 0.98


@dataclass(frozen=True)
class BoardRig:
    """Cameras in metres, in the first camera's frame.

    Attributes:
        cameras: Name -> camera; index: name -> camera of the problem.
        solution: The bundle adjustment, with covariances.
        views: What it was given and did not drop.
        rms_px: Over these corners.
        dropped: (camera, frame) of the views that did not fit.
        gap_ms: Median and largest time between views that count as one instant, by the given times.
        shallow: Cameras that saw the board at one distance only, and so keep to their calibration.
        left_out: Camera that the board does not tie to the others -> why.
    """

    cameras: dict[str, Camera]
    solution: BundleSolution
    views: Views
    rms_px: float
    dropped: tuple[tuple[str, int], ...]
    gap_ms: tuple[float, float]
    shallow: tuple[str, ...]
    left_out: dict[str, str]

    @property
    def delay_s(self) -> dict[str, float]:
        """What has to be added to each camera's times to have the first camera's clock."""
        timing = self.solution.problem.timing
        assert timing is not None
        return dict(zip(self.views.names, timing.delay_s.tolist(), strict=True))


def weak_intrinsics(own: Intrinsics, pixel_aspect: float = 1.0) -> Intrinsics:
    """What is known of a camera whose only calibration are the joint views themselves: that it is a camera.

    The focal length is free, pixels are as wide as the file says, the principal point lies near the centre.
    """
    vector = np.array([own.K[0, 0], pixel_aspect * own.K[0, 0], own.width / 2, own.height / 2, *np.zeros(5)])
    weak = PRINCIPAL_POINT_STD * max(own.width, own.height)
    std = np.array([np.inf, np.inf, weak, weak, *DISTORTION_STD])
    if own.model == "OPENCV_FISHEYE":
        std[4:] = [*np.full(4, DISTORTION_STD[0]), 0.0]
    return from_vector(own.width, own.height, vector, std, own.model)


def rig_from_board(
    views: Mapping[str, list[TimedView]],
    spec: BoardSpec,
    start: Mapping[str, Intrinsics],
    known: Mapping[str, Intrinsics],
    progress: Progress = no_progress,
) -> BoardRig:
    """Calibrate the rig.

    Args:
        views: Camera -> its views, on one clock.
        spec: The settled board.
        start: Camera -> intrinsics to start from.
        known: Camera -> what is known of its intrinsics apart from these views (`std` says how well).
        progress: Called per round.
    Raises:
        HealthError: The board ties too few cameras to go on without the others, which are named.
    """
    seen = gather(views, spec, start)
    lost = untied(seen)
    if lost and len(views) - len(lost) >= ENOUGH_CAMERAS:
        seen = gather({n: own for n, own in views.items() if n not in lost}, spec, start)
    gap_ms = _gaps_ms(seen)
    poses = start_poses(seen, spanning_tree(seen))
    problem = _problem(seen, spec, poses, [start[n] for n in seen.names], [known[n] for n in seen.names])
    problem = replace(problem, firm_prior=_shallow(problem))
    fit = _rounds(seen, spec, problem, progress)
    cameras = {}
    for c, name in enumerate(seen.names):
        k = from_vector(
            start[name].width, start[name].height, fit.solution.problem.intrinsics[c], None, start[name].model
        )
        cameras[name] = k.at(fit.solution.problem.poses[c])
    return BoardRig(
        cameras=cameras,
        solution=fit.solution,
        views=fit.seen,
        rms_px=float(np.sqrt((fit.solution.residual_px**2).sum(1).mean())),
        dropped=fit.dropped,
        gap_ms=gap_ms,
        shallow=tuple(n for n, firm in zip(seen.names, problem.firm_prior, strict=True) if firm),
        left_out=lost,
    )


def boards_before(
    cameras: Mapping[str, Camera],
    delay_s: Mapping[str, float],
    views: Mapping[str, list[TimedView]],
    spec: BoardSpec,
) -> tuple[BundleSolution, Views]:
    """The board's pose at every instant before cameras that are known; each picture's lag is found too."""
    fixed = {n: Intrinsics(c.width, c.height, c.K, c.distortion, None, c.model) for n, c in cameras.items()}
    seen = gather(views, spec, fixed)
    delays = np.array([delay_s[n] for n in seen.names])
    poses = np.array([cameras[n].cam_from_world for n in seen.names])
    own = [fixed[n] for n in seen.names]
    problem = _problem(seen.regrouped(delays), spec, poses, own, own, delays)
    problem = replace(problem, free_pose=np.zeros(len(poses), dtype=bool))
    fit = _rounds(seen.regrouped(delays), spec, problem, no_progress, drop=False)
    return fit.solution, fit.seen


@dataclass(frozen=True)
class _Fit:
    solution: BundleSolution
    seen: Views
    dropped: tuple[tuple[str, int], ...]


def _problem(
    seen: Views,
    spec: BoardSpec,
    poses: Float[np.ndarray, "cameras 3 4"],
    start: list[Intrinsics],
    known: list[Intrinsics],
    delay_s: Float[np.ndarray, " cameras"] | None = None,
) -> Problem:
    """Boards where one camera sees them, and nothing known of the clocks; or clocks that are known."""
    C = len(poses)
    free = np.arange(C) > 0
    timing = replace(
        still(seen.obs_view, C, len(seen.camera)),
        delay_s=np.zeros(C) if delay_s is None else delay_s,
        free_delay=free if delay_s is None else ~free & free,
        lag_std_s=START_LAG_S,
    )
    return Problem(
        poses=poses,
        free_pose=free,
        device=np.arange(C),
        **lenses(start, known),
        bodies=start_boards(seen, poses),
        freedom=np.full(len(seen.instant_s), 6),
        **_observations(seen, spec),
        obs_std=np.full(len(seen.obs_id), START_NOISE_PX),
        timing=timing,
    )


def _observations(seen: Views, spec: BoardSpec) -> Observations:
    return {
        "obs_camera": seen.camera[seen.obs_view],
        "obs_body": seen.instant[seen.obs_view],
        "obs_local": spec.corners[seen.obs_id],
        "obs_xy": seen.obs_xy,
    }


def _rounds(seen: Views, spec: BoardSpec, problem: Problem, progress: Progress, drop: bool = True) -> _Fit:
    """Adjust until times, noise and the choice of views have settled; the gentler loss first."""
    dropped: list[tuple[str, int]] = []
    solution = adjust(problem, "soft_l1")
    for n in range(ROUNDS):
        progress(n / ROUNDS, f"bundle adjustment, round {n + 1}: {solution.sigma_px:.2f} px")
        late = n >= ROUNDS // 2
        bad = _bad_views(seen, solution) if drop and late else np.zeros(len(seen.camera), dtype=bool)
        dropped += [(seen.names[seen.camera[v]], int(seen.frame[v])) for v in np.flatnonzero(bad)]
        seen, problem = _next(seen, spec, solution, ~bad)
        if bad.any():
            spanning_tree(seen)
        before, solution = solution, adjust(problem, "cauchy" if late else "soft_l1")
        if late and not bad.any() and _settled(before, solution):
            break
    return _Fit(solution, seen, tuple(dropped))


def _settled(before: BundleSolution, now: BundleSolution) -> bool:
    """Whether a round has changed the cameras by less than a tenth of their standard deviations."""
    std = np.sqrt(np.einsum("cii->ci", now.pose_covariance)[:, 3:].sum(1))
    moved = np.linalg.norm(now.problem.poses[:, :, 3] - before.problem.poses[:, :, 3], axis=1)
    return bool((moved <= SETTLED_STDS * std).all())


def _next(
    seen: Views, spec: BoardSpec, solution: BundleSolution, good: Bool[np.ndarray, " views"]
) -> tuple[Views, Problem]:
    """The problem of the next round: instants, motion, lags and noise as the last one showed them."""
    problem, timing = solution.problem, _timing(solution.problem)
    noise_px = max(solution.sigma_px, MIN_NOISE_PX)
    lag_std_s = _lag_spread(problem, noise_px, seen.period_s)
    fresh = seen.keep(good).regrouped(timing.delay_s)
    nearest = np.abs(seen.instant_s[None] - fresh.instant_s[:, None]).argmin(1)
    boards, lag_s = problem.bodies[nearest], timing.lag_s[good]
    carry, spin, velocity = carried(
        boards,
        spec.corners.mean(0),
        fresh.instant_s,
        fresh.period_s,
        fresh.instant,
        fresh.offset_s(timing.delay_s) + lag_s,
    )
    timing = replace(
        timing,
        view=fresh.obs_view,
        carry=carry,
        carried_s=timing.delay_s[fresh.camera] + lag_s,
        spin=spin,
        velocity=velocity,
        lag_s=lag_s,
        lag_std_s=lag_std_s,
    )
    return fresh, replace(
        problem,
        bodies=boards,
        freedom=np.full(len(boards), 6),
        **_observations(fresh, spec),
        obs_std=np.full(len(fresh.obs_id), noise_px),
        timing=timing,
    )


def _lag_spread(problem: Problem, noise_px: float, period_s: float) -> float:
    """Standard deviation of the lags, from the pictures that move fast enough to tell; robust."""
    timing = _timing(problem)
    speed = np.bincount(timing.view, (image_rate(problem) ** 2).sum(1), len(timing.lag_s))
    tells = noise_px < TIMED_SHARE * timing.lag_std_s * np.sqrt(speed)
    if not tells.any():
        return timing.lag_std_s
    return float(np.clip(robust_sigma(timing.lag_s[tells]), MIN_LAG_S, max(period_s / 2, MIN_LAG_S)))


def _shallow(problem: Problem) -> Bool[np.ndarray, " cameras"]:
    """Cameras whose focal length is calibrated and that saw the board at too few distances to contradict that."""
    out = np.isfinite(problem.prior_std[:, 0])
    distance = depths(problem)
    for c in np.flatnonzero(out):
        near, far = np.quantile(distance[problem.obs_camera == c], DEPTH_QUANTILES)
        out[c] = far < MIN_DEPTH_RATIO * near
    return out


def _bad_views(seen: Views, solution: BundleSolution) -> Bool[np.ndarray, " views"]:
    squared = (solution.residual_px**2).sum(1)
    count = np.maximum(np.bincount(seen.obs_view, minlength=len(seen.camera)), 1)
    rms = np.sqrt(np.bincount(seen.obs_view, squared, len(seen.camera)) / count)
    return rms > OUTLIER_FACTOR * max(float(np.quantile(rms, OUTLIER_QUANTILE)), OUTLIER_FLOOR_PX)


def _timing(problem: Problem) -> ViewTiming:
    assert problem.timing is not None
    return problem.timing


def _gaps_ms(seen: Views) -> tuple[float, float]:
    offset_s = seen.offset_s(np.zeros(len(seen.names)))
    groups = [offset_s[seen.instant == i] for i in np.unique(seen.instant)]
    gaps = [float(np.ptp(group)) for group in groups if len(group) > 1]
    return (1e3 * float(np.median(gaps)), 1e3 * max(gaps)) if gaps else (0.0, 0.0)
