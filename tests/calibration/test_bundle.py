"""Bundle adjustment against scenes of which everything is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from devrf.calibration.bundle.adjust import adjust
from devrf.calibration.bundle.model import jacobians, reprojection
from devrf.calibration.bundle.problem import Problem, ViewTiming, bodies_of_points
from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at

TRUE_K = np.array([500.0, 505.0, 321.0, 239.0, -0.1, 0.02, 0.001, -0.002, 0.003])


def ring_problem(cameras: int = 8, points: int = 120, noise_px: float = 0.0, seed: int = 0) -> Problem:
    """Cameras on a ring look at a cloud of points; one device; everything free but the first two poses."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1, 1, (points, 3))
    poses = []
    for angle in np.linspace(0, 1.5 * np.pi, cameras):
        centre = np.array([4 * np.cos(angle), 0.6 * np.sin(3 * angle), 4 * np.sin(angle)])
        poses.append(look_at(centre, np.zeros(3), (0.0, 1.0, 0.0)))
    obs_camera = np.repeat(np.arange(cameras), points)
    obs_point = np.tile(np.arange(points), cameras)
    problem = Problem(
        poses=np.array(poses),
        free_pose=np.arange(cameras) >= 2,
        device=np.zeros(cameras, dtype=np.int64),
        intrinsics=TRUE_K[None].copy(),
        fisheye=np.zeros(1, dtype=bool),
        free_intrinsics=np.ones((1, 9), dtype=bool),
        bodies=bodies_of_points(xyz),
        freedom=np.full(points, 3),
        obs_camera=obs_camera,
        obs_body=obs_point,
        obs_local=np.zeros((len(obs_point), 3)),
        obs_xy=np.zeros((len(obs_point), 2)),
        obs_std=np.full(len(obs_point), 0.5),
        one_focal=np.zeros(1, dtype=bool),
        prior_mean=TRUE_K[None].copy(),
        prior_std=np.full((1, 9), np.inf),
        firm_prior=np.zeros(1, dtype=bool),
    )
    return replace(
        problem, obs_xy=reprojection(problem) + noise_px * rng.standard_normal((len(obs_point), 2))
    )


def board_problem(noise_px: float = 0.0, seed: int = 0) -> Problem:
    """Three cameras of their own devices see 12 instants of a board that moves on between their pictures.

    The second camera's clock is 20 ms late, every picture has a lag of its own; both are known to the problem.
    """
    rng = np.random.default_rng(seed)
    ring, cameras, instants = ring_problem(cameras=3, points=1), 3, 12
    corners = np.column_stack([np.mgrid[0:4, 0:3].reshape(2, -1).T * 0.3, np.zeros(12)])
    bodies = np.array(
        [
            np.column_stack([cv2.Rodrigues(0.5 * rng.standard_normal(3))[0], 0.4 * rng.standard_normal(3)])
            for _ in range(instants)
        ]
    )
    view = np.repeat(np.arange(cameras * instants), len(corners))
    delay_s, lag_s = np.array([0.0, 0.02, 0.0]), 5e-3 * rng.standard_normal(cameras * instants)
    problem = replace(
        ring,
        free_pose=np.arange(cameras) >= 1,
        device=np.arange(cameras),
        intrinsics=np.tile(TRUE_K, (cameras, 1)),
        fisheye=np.array([False, False, True]),
        free_intrinsics=np.zeros((cameras, 9), dtype=bool),
        one_focal=np.array([True, False, False]),
        prior_mean=np.tile(TRUE_K, (cameras, 1)),
        prior_std=np.full((cameras, 9), np.inf),
        firm_prior=np.zeros(cameras, dtype=bool),
        bodies=bodies,
        freedom=np.full(instants, 6),
        obs_camera=view % cameras,
        obs_body=view // cameras,
        obs_local=np.tile(corners, (cameras * instants, 1)),
        obs_xy=np.zeros((len(view), 2)),
        obs_std=np.full(len(view), max(noise_px, 0.1)),
        unit=0.8,
        timing=ViewTiming(
            view=view,
            carry=np.tile(np.eye(3, 4), (cameras * instants, 1, 1)),
            carried_s=np.zeros(cameras * instants),
            spin=np.repeat(0.8 * rng.standard_normal((instants, 3)), cameras, axis=0),
            velocity=np.repeat(0.5 * rng.standard_normal((instants, 3)), cameras, axis=0),
            delay_s=delay_s,
            delay_std_s=0.1,
            free_delay=np.array([False, True, True]),
            lag_s=lag_s,
            lag_std_s=5e-3,
        ),
    )
    return replace(problem, obs_xy=reprojection(problem) + noise_px * rng.standard_normal((len(view), 2)))


def disturbed(problem: Problem, seed: int = 1) -> Problem:
    """Start values about 1 degree, 2 % and 3 % off."""
    rng = np.random.default_rng(seed)
    poses = problem.poses.copy()
    for c in np.flatnonzero(problem.free_pose):
        poses[c] = cv2.Rodrigues(0.02 * rng.standard_normal(3))[0] @ poses[c]
        poses[c, :, 3] += 0.05 * rng.standard_normal(3)
    intrinsics = np.where(problem.free_intrinsics, problem.intrinsics * [1.03] * 9, problem.intrinsics)
    bodies = problem.bodies.copy()
    bodies[:, :, 3] += np.where(
        problem.freedom[:, None] > 0, 0.03 * rng.standard_normal(bodies[:, :, 3].shape), 0.0
    )
    return replace(problem, poses=poses, intrinsics=intrinsics, bodies=bodies)


def rotation_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(a[:, :3] @ b[:, :3].T)[0])))


def test_projection_is_the_cameras():
    problem = ring_problem(2, 5)
    k = TRUE_K
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    camera = Camera(640, 480, K, problem.poses[1], k[4:])
    np.testing.assert_allclose(problem.obs_xy[5:], camera.project(problem.points), atol=1e-9)


@pytest.mark.parametrize("loss", ["linear", "soft_l1", "cauchy"])
def test_exact_observations_give_back_the_truth(loss):
    truth = ring_problem()
    found = adjust(disturbed(truth), loss).problem
    assert max(rotation_deg(a, b) for a, b in zip(found.poses, truth.poses, strict=True)) < 1e-4
    np.testing.assert_allclose(found.points, truth.points, atol=1e-4)
    np.testing.assert_allclose(found.intrinsics[:, :4], truth.intrinsics[:, :4], atol=1e-2)


def test_errors_agree_with_the_covariance():
    """Over cameras and seeds, pose errors in units of their standard deviation have a mean square near 1."""
    squares = []
    for seed in range(6):
        truth = ring_problem(noise_px=0.3, seed=seed)
        exact = ring_problem(seed=seed)
        solution = adjust(disturbed(truth, seed), "linear")
        for c in np.flatnonzero(truth.free_pose):
            turn = cv2.Rodrigues(solution.problem.poses[c, :, :3] @ exact.poses[c, :, :3].T)[0].reshape(3)
            std = np.sqrt(np.diag(solution.pose_covariance[c])[:3])
            squares += ((turn / std) ** 2).tolist()
        assert solution.sigma_px == pytest.approx(0.3, rel=0.1)
    assert 0.5 < np.mean(squares) < 2.0  # 108 values: their mean has a standard deviation of about 0.3


def test_robust_loss_survives_outliers():
    truth = ring_problem(noise_px=0.2)
    xy = truth.obs_xy.copy()
    wrong = np.random.default_rng(3).choice(len(xy), len(xy) // 10, replace=False)
    xy[wrong] += 40.0
    found = adjust(disturbed(replace(truth, obs_xy=xy)), "cauchy").problem
    plain = adjust(disturbed(replace(truth, obs_xy=xy)), "linear").problem
    worst = [
        max(rotation_deg(a, b) for a, b in zip(p.poses, truth.poses, strict=True)) for p in (found, plain)
    ]
    assert worst[0] < 0.1 < worst[1]


def test_held_parameters_stay():
    truth = ring_problem()
    free = np.zeros((1, 9), dtype=bool)
    free[0, 0] = True
    start = disturbed(
        replace(truth, free_intrinsics=free, freedom=np.zeros(len(truth.bodies), dtype=np.int64))
    )
    found = adjust(start).problem
    np.testing.assert_array_equal(found.poses[:2], truth.poses[:2])
    np.testing.assert_array_equal(found.points, truth.points)
    np.testing.assert_array_equal(found.intrinsics[0, 1:], truth.intrinsics[0, 1:])
    assert found.intrinsics[0, 0] == pytest.approx(TRUE_K[0], abs=1e-3)


def test_one_focal_keeps_the_ratio():
    truth = ring_problem()
    start = disturbed(replace(truth, one_focal=np.ones(1, dtype=bool)))
    found = adjust(start).problem
    ratio = start.intrinsics[0, 1] / start.intrinsics[0, 0]
    assert found.intrinsics[0, 1] / found.intrinsics[0, 0] == pytest.approx(ratio, rel=1e-12)


def test_a_tight_prior_wins_over_few_observations():
    truth = ring_problem(cameras=3, points=8, noise_px=1.0)
    prior = np.full((1, 9), 1e-3)
    start = replace(truth, prior_std=prior, intrinsics=1.02 * truth.intrinsics)
    found = adjust(start).problem
    np.testing.assert_allclose(found.intrinsics, TRUE_K[None], atol=5e-3)


def test_without_observations_it_refuses():
    problem = ring_problem(2, 3)
    observations = ("obs_camera", "obs_body", "obs_local", "obs_xy", "obs_std")
    empty = replace(problem, **{name: getattr(problem, name)[:0] for name in observations})
    with pytest.raises(ValueError, match="without observations"):
        adjust(empty)


def test_derivatives_are_those_of_the_projection():
    """Central differences with a step of 1e-6 are exact to about 1e-6 of a derivative of order 1000 px."""
    problem = board_problem()
    d_pose, d_k, d_body, d_time, d_unit = jacobians(problem)
    timing = problem.timing
    assert timing is not None

    def moved(vectors: np.ndarray, body: bool, sign: float, n: int) -> Problem:
        step = np.zeros(6)
        step[n] = sign * 1e-6
        out = vectors.copy()
        out[:, :, :3] = cv2.Rodrigues(step[:3])[0] @ out[:, :, :3]
        if not body:  # a camera's translation turns along, a body turns about its own origin
            out[:, :, 3] = out[:, :, 3] @ cv2.Rodrigues(step[:3])[0].T
        out[:, :, 3] += step[3:]
        return replace(problem, bodies=out) if body else replace(problem, poses=out)

    def slope(of) -> np.ndarray:
        return (reprojection(of(1.0)) - reprojection(of(-1.0))) / 2e-6

    for n in range(6):
        pose = slope(lambda sign, n=n: moved(problem.poses, False, sign, n))
        body = slope(lambda sign, n=n: moved(problem.bodies, True, sign, n))
        np.testing.assert_allclose(d_pose[:, :, n], pose, atol=5e-3)
        np.testing.assert_allclose(d_body[:, :, n], body, atol=5e-3)
    late = slope(lambda sign: replace(problem, timing=replace(timing, lag_s=timing.lag_s + sign * 1e-6)))
    np.testing.assert_allclose(d_time, late, atol=5e-3)
    larger = slope(lambda sign: replace(problem, unit=problem.unit * float(np.exp(sign * 1e-6))))
    np.testing.assert_allclose(d_unit, larger, atol=5e-3)
    principal = slope(
        lambda sign: replace(problem, intrinsics=problem.intrinsics + sign * 1e-6 * np.eye(9)[2])
    )
    np.testing.assert_allclose(d_k[:, :, 2], principal, atol=5e-3)


def test_boards_and_clocks_come_back():
    """From poses, boards and clocks that are off, without noise; the priors on the clocks pull by less than 1 ms."""
    truth = board_problem()
    timing = truth.timing
    assert timing is not None
    start = disturbed(truth)
    start = replace(start, timing=replace(timing, delay_s=np.zeros(3), lag_s=np.zeros(len(timing.lag_s))))
    found = adjust(start, "soft_l1").problem
    assert found.timing is not None
    assert max(rotation_deg(a, b) for a, b in zip(found.poses, truth.poses, strict=True)) < 0.01
    # up to the mean of 12 lags of 5 ms: 1.5 ms
    assert found.timing.delay_s[1] == pytest.approx(0.02, abs=3e-3)
    late, true = (t.delay_s[truth.obs_camera] + t.lag_s[t.view] for t in (found.timing, timing))
    against_first = (late - true).reshape(12, 3, 12)[:, :, 0]
    np.testing.assert_allclose(against_first[:, 1:] - against_first[:, :1], 0.0, atol=1e-3)


def test_a_prior_that_is_far_off_gives_way():
    """The observations fix the focal length to 0.5 px; a prior 50 px off that claims 0.1 px would drag a fit
    that believes it by 50 * 0.5^2 / (0.5^2 + 0.1^2) = 48 px."""
    truth = ring_problem(noise_px=0.3)
    std = np.full((1, 9), np.inf)
    std[0, :2] = 0.1
    mean = truth.intrinsics.copy()
    mean[0, :2] += 50.0
    found = adjust(replace(truth, prior_mean=mean, prior_std=std))
    assert abs(found.problem.intrinsics[0, 0] - TRUE_K[0]) < 4 * float(found.intrinsics_std[0, 0]) < 4.0
    firm = adjust(replace(truth, prior_mean=mean, prior_std=std, firm_prior=np.ones(1, dtype=bool)))
    assert abs(firm.problem.intrinsics[0, 0] - mean[0, 0]) < 5.0


def test_corners_that_err_together_widen_the_covariance():
    """All 12 corners of a view shifted together by 0.5 px: they are worth little more than one corner, and the
    standard deviations grow by up to sqrt(12) = 3.5 against the noise of a corner."""
    rng = np.random.default_rng(0)
    exact = replace(board_problem(), timing=None)
    exact = replace(exact, obs_xy=reprojection(exact) + exact.obs_xy)
    view = np.repeat(np.arange(36), 12)
    alone = replace(exact, obs_xy=exact.obs_xy + 0.5 * rng.standard_normal(exact.obs_xy.shape))
    together = replace(exact, obs_xy=exact.obs_xy + 0.5 * rng.standard_normal((36, 2))[view])
    std = [
        np.sqrt(np.trace(s.pose_covariance[1])) / s.sigma_px
        for s in (adjust(p, "linear") for p in (alone, together))
    ]
    assert std[1] > 1.5 * std[0]
