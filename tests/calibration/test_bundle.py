"""Bundle adjustment against scenes of which everything is known."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from devrf.calibration.bundle import Problem, adjust, distort_many, reprojection
from devrf.capture.camera import Camera, distort

TRUE_K = np.array([500.0, 505.0, 321.0, 239.0, -0.1, 0.02, 0.001, -0.002, 0.003])


def ring_problem(cameras: int = 8, points: int = 120, noise_px: float = 0.0, seed: int = 0) -> Problem:
    """Cameras on a ring look at a cloud of points; one device; everything free but the first two poses."""
    rng = np.random.default_rng(seed)
    xyz = rng.uniform(-1, 1, (points, 3))
    poses = []
    for angle in np.linspace(0, 1.5 * np.pi, cameras):
        centre = np.array([4 * np.cos(angle), 0.6 * np.sin(3 * angle), 4 * np.sin(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross([0.0, -1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        poses.append(np.column_stack([R, -R @ centre]))
    obs_camera = np.repeat(np.arange(cameras), points)
    obs_point = np.tile(np.arange(points), cameras)
    problem = Problem(
        poses=np.array(poses),
        intrinsics=TRUE_K[None].copy(),
        device=np.zeros(cameras, dtype=np.int64),
        points=xyz,
        obs_camera=obs_camera,
        obs_point=obs_point,
        obs_xy=np.zeros((len(obs_point), 2)),
        free_pose=np.arange(cameras) >= 2,
        free_intrinsics=np.ones((1, 9), dtype=bool),
        free_points=True,
        one_focal=np.zeros(1, dtype=bool),
        prior_mean=TRUE_K[None].copy(),
        prior_std=np.full((1, 9), np.inf),
    )
    return replace(
        problem, obs_xy=reprojection(problem) + noise_px * rng.standard_normal((len(obs_point), 2))
    )


def disturbed(problem: Problem, seed: int = 1) -> Problem:
    """Start values about 1 degree, 2 % and 3 % off."""
    rng = np.random.default_rng(seed)
    poses = problem.poses.copy()
    for c in np.flatnonzero(problem.free_pose):
        poses[c] = cv2.Rodrigues(0.02 * rng.standard_normal(3))[0] @ poses[c]
        poses[c, :, 3] += 0.05 * rng.standard_normal(3)
    intrinsics = np.where(problem.free_intrinsics, problem.intrinsics * [1.03] * 9, problem.intrinsics)
    points = problem.points + (
        0.03 * rng.standard_normal(problem.points.shape) if problem.free_points else 0.0
    )
    return replace(problem, poses=poses, intrinsics=intrinsics, points=points)


def rotation_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(cv2.Rodrigues(a[:, :3] @ b[:, :3].T)[0])))


def test_projection_is_the_cameras():
    problem = ring_problem(2, 5)
    k = TRUE_K
    K = np.array([[k[0], 0, k[2]], [0, k[1], k[3]], [0, 0, 1]])
    camera = Camera(640, 480, K, problem.poses[1], k[4:])
    np.testing.assert_allclose(problem.obs_xy[5:], camera.project(problem.points), atol=1e-9)
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (7, 2))
    np.testing.assert_allclose(distort_many(x, np.tile(k[4:], (7, 1))), distort(x, k[4:]), atol=1e-15)


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
    start = disturbed(replace(truth, free_intrinsics=free, free_points=False))
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
    empty = replace(
        problem, obs_camera=problem.obs_camera[:0], obs_point=problem.obs_point[:0], obs_xy=problem.obs_xy[:0]
    )
    with pytest.raises(ValueError, match="without observations"):
        adjust(empty)
