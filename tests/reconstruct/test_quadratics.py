"""What pictures want of points, by kernels and written out, against differences of the squares themselves."""

from dataclasses import replace

import numpy as np
import pytest

import devrf.reconstruct.tracking.solver.quadratics as module
from devrf.capture.camera import Camera
from devrf.reconstruct.tracking.solver.quadratics import SeenPoints, Sum, huber_weight

POINTS, SHARE, HUBER = 40, 0.7, 1e3
CAMERA = Camera(
    K=np.array([[300.0, 0, 160], [0, 310.0, 120], [0, 0, 1]]),
    cam_from_world=np.array([[0.8, 0, 0.6, 0.1], [0, 1, 0, -0.2], [-0.6, 0, 0.8, 3.0]]),
    width=320,
    height=240,
)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(6)


@pytest.fixture
def seen(rng: np.random.Generator) -> SeenPoints:
    xyz = rng.uniform(-0.5, 0.5, (POINTS // 2, 3))
    points = rng.permutation(POINTS)[: POINTS // 2]
    return SeenPoints(points, xyz, CAMERA.project(xyz), CAMERA, SHARE)


@pytest.fixture(params=[True, False], ids=["warp", "written out"])
def warp(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "use_warp", lambda device: request.param)


def gauss_newton(seen: SeenPoints, residuals, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """H and b of all points by central differences of their residuals."""
    step, columns = 1e-5, []
    for axis in np.eye(3):
        ends = [residuals(seen.xyz + sign * step * SHARE * axis) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    J, r = np.stack(columns, -1), residuals(seen.xyz)
    H, b = np.zeros((POINTS, 3, 3)), np.zeros((POINTS, 3))
    H[seen.points] = weight[:, None, None] * (J.mT @ J)
    b[seen.points] = weight[:, None] * (J.mT @ r[..., None])[..., 0]
    return H, b


@pytest.mark.usefixtures("warp")
def test_points_are_pulled_to_places(rng: np.random.Generator, seen: SeenPoints) -> None:
    target, weight = seen.at + rng.normal(size=seen.at.shape), rng.random(len(seen.points))
    sums = Sum(POINTS)
    sums.add_places(seen, target, weight, HUBER)
    H, b = gauss_newton(seen, lambda xyz: CAMERA.project(xyz) - target, weight)
    np.testing.assert_allclose(sums.hessian, H, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(sums.gradient, b, rtol=1e-6, atol=1e-3)
    assert (sums.hessian[np.setdiff1d(np.arange(POINTS), seen.points)] == 0).all()


@pytest.mark.usefixtures("warp")
def test_points_are_pulled_to_where_they_look_alike(rng: np.random.Generator, seen: SeenPoints) -> None:
    apart, slope = rng.normal(size=(len(seen.at), 3)), rng.normal(size=(len(seen.at), 3, 2))
    begin, sums = seen.at + rng.normal(size=seen.at.shape), Sum(POINTS)
    sums.add_brightness(seen, apart, slope, begin, 2.5, HUBER)

    def residuals(xyz: np.ndarray) -> np.ndarray:
        return apart + np.einsum("mij,mj->mi", slope, CAMERA.project(xyz) - begin)

    H, b = gauss_newton(seen, residuals, np.full(len(seen.at), 2.5))
    np.testing.assert_allclose(sums.hessian, H, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(sums.gradient, b, rtol=1e-6, atol=1e-3)


@pytest.mark.usefixtures("warp")
def test_what_is_far_off_weighs_less_and_what_is_not_seen_nothing(seen: SeenPoints) -> None:
    off, one = np.linspace(0, 8, len(seen.at)), np.ones(len(seen.at))
    far, full = Sum(POINTS), Sum(POINTS)
    far.add_places(seen, seen.at + off[:, None] * [0.6, 0.8], one, 2.0)
    full.add_places(seen, seen.at + off[:, None] * [0.6, 0.8], one, HUBER)
    weights = far.hessian[seen.points, 0, 0] / full.hessian[seen.points, 0, 0]
    np.testing.assert_allclose(weights, huber_weight(off, 2.0))

    none = Sum(POINTS)
    none.add_places(replace(seen, at=np.full_like(seen.at, np.nan)), seen.at, one, 2.0)
    unknown = np.full((len(seen.at), 3), np.nan)
    none.add_brightness(seen, unknown, np.ones((len(seen.at), 3, 2)), seen.at, 1.0, 2.0)
    nobody = SeenPoints(seen.points[:0], seen.xyz[:0], seen.at[:0], CAMERA, SHARE)
    none.add_places(nobody, seen.at[:0], one[:0], 2.0)
    none.add_brightness(nobody, unknown[:0], np.ones((0, 3, 2)), seen.at[:0], 1.0, 2.0)
    assert not none.hessian.any() and not none.gradient.any()


@pytest.mark.usefixtures("warp")
def test_pictures_add_up_and_some_points_can_be_left_out(seen: SeenPoints) -> None:
    one, target = np.ones(len(seen.at)), seen.at + 1.0
    first, both = Sum(POINTS), Sum(POINTS)
    first.add_places(seen, target, one, HUBER)
    both.add_places(seen, target, one, HUBER)
    both.join(first)
    np.testing.assert_allclose(both.hessian, 2 * first.hessian)
    kept = np.arange(POINTS) % 2 == 0
    pulls = both.of(kept)
    np.testing.assert_array_equal(pulls.hessian[kept], both.hessian[kept])
    assert not pulls.hessian[~kept].any() and not pulls.gradient[~kept].any()
