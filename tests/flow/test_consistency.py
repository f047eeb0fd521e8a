"""The consistency rule, warping and resizing, against closed forms."""

import numpy as np
import pytest

from devrf.flow.consistency import consistent, resize_flow, round_trip, supported, warp, warp_residuals


def constant(u: float, v: float, height: int = 20, width: int = 30) -> np.ndarray:
    return np.broadcast_to(np.array([u, v], np.float32), (height, width, 2)).copy()


def test_warp_fetches_where_the_flow_leads():
    y, x = np.mgrid[:20, :30].astype(np.float32)
    ramp = np.stack([2 * x + y, x - 3 * y], axis=-1)
    out = warp(ramp, constant(1.5, -0.25))
    inner = (slice(2, -2), slice(2, -3))
    expected = np.stack([2 * (x + 1.5) + y - 0.25, x + 1.5 - 3 * (y - 0.25)], axis=-1)
    np.testing.assert_allclose(out[inner], expected[inner], atol=0.05)  # OpenCV interpolates at 1/32 px


def test_exact_inverse_is_valid_inside_and_the_way_out_is_not():
    flow, back = constant(4, 0), constant(-4, 0)
    valid = consistent(flow, back)
    assert valid[:, :26].all() and not valid[:, 26:].any()
    np.testing.assert_allclose(round_trip(flow, back), 0, atol=1e-6)


@pytest.mark.parametrize(("miss", "good"), [(4.84, True), (4.86, False)])
def test_rule_is_half_of_the_lengths_plus_half_a_pixel(miss, good):
    # f = (3, 0), b = (-3, m): |f + b| = m, and m = 0.5 (3 + sqrt(9 + m^2)) + 0.5 at m = (8 + sqrt(43)) / 3
    assert bool(consistent(constant(3, 0), constant(-3, miss))[10, 10]) == good


def test_swapped_direction_is_not_consistent():
    assert not consistent(constant(4, 1), constant(4, 1)).any()


def test_plain_backdrop_has_nothing_to_follow():
    picture = np.full((40, 60, 3), 255, np.uint8)
    picture[10:30, 10:30] = np.random.default_rng(0).integers(90, 110, (20, 20, 3))
    ok = supported(picture)
    assert ok[10:30, 10:30].all() and not ok[:, 40:].any()


def test_vectors_scale_with_each_side():
    flow, valid = resize_flow(constant(6, 8, 20, 30), np.ones((20, 30), bool), 10, 10)
    assert flow.shape == (10, 10, 2) and valid.all()
    np.testing.assert_allclose(flow, np.broadcast_to(np.array([2, 4], np.float32), flow.shape), atol=1e-5)


def test_invalid_vectors_do_not_bleed():
    flow, valid = constant(2, 2, 4, 4), np.ones((4, 4), bool)
    flow[0, 0] = 100
    valid[0, 0] = False
    valid[2:, 2:] = False
    small, ok = resize_flow(flow, valid, 2, 2)
    np.testing.assert_allclose(small[0, 0], [1, 1], atol=1e-5)
    np.testing.assert_array_equal(ok, [[True, True], [True, False]])


def test_same_size_changes_nothing():
    rng = np.random.default_rng(0)
    flow, valid = rng.normal(size=(9, 7, 2)).astype(np.float32), rng.random((9, 7)) > 0.5
    out, ok = resize_flow(flow, valid, 7, 9)
    np.testing.assert_array_equal(out, flow)
    np.testing.assert_array_equal(ok, valid)


def test_warping_tells_the_right_direction():
    rng = np.random.default_rng(0)
    previous = np.repeat(rng.integers(0, 255, (24, 40, 1)), 3, axis=2).astype(np.uint8)
    current = np.roll(previous, 3, axis=1)  # content moved right by 3: backward flow is (-3, 0)
    inner = np.zeros((24, 40), bool)
    inner[:, 8:-8] = True
    right, still = warp_residuals(previous, current, constant(-3, 0, 24, 40), inner)
    wrong, _ = warp_residuals(previous, current, constant(3, 0, 24, 40), inner)
    assert right < 0.01 * still and wrong > 0.5 * still
