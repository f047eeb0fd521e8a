"""The consistency rule, warping and resizing, against closed forms."""

import numpy as np
import pytest

from devrf.flow.consistency import resize_flow, round_trip, supported, warp


def constant(u: float, v: float, height: int = 20, width: int = 30) -> np.ndarray:
    return np.broadcast_to(np.array([u, v], np.float32), (height, width, 2)).copy()


def test_warp_fetches_where_the_flow_leads():
    y, x = np.mgrid[:20, :30].astype(np.float32)
    ramp = np.stack([2 * x + y, x - 3 * y], axis=-1)
    out = warp(ramp, constant(1.5, -0.25))
    inner = (slice(2, -2), slice(2, -3))
    expected = np.stack([2 * (x + 1.5) + y - 0.25, x + 1.5 - 3 * (y - 0.25)], axis=-1)
    # a plane is interpolated exactly; places are kept to single precision of 30 px, 2e-6 px, at slopes of 3
    np.testing.assert_allclose(out[inner], expected[inner], atol=1e-4)


def test_exact_inverse_is_valid_inside_and_the_way_out_is_not():
    flow, back = constant(4, 0), constant(-4, 0)
    missed, valid = round_trip(flow, back)
    assert valid[:, :26].all() and not valid[:, 26:].any()
    np.testing.assert_allclose(missed, 0, atol=1e-6)


@pytest.mark.parametrize(("miss", "good"), [(4.84, True), (4.86, False)])
def test_rule_is_half_of_the_lengths_plus_half_a_pixel(miss, good):
    # f = (3, 0), b = (-3, m): |f + b| = m, and m = 0.5 (3 + sqrt(9 + m^2)) + 0.5 at m = (8 + sqrt(43)) / 3
    missed, valid = round_trip(constant(3, 0), constant(-3, miss))
    assert bool(valid[10, 10]) == good and missed[10, 10] == pytest.approx(miss)


def test_swapped_direction_is_not_consistent():
    assert not round_trip(constant(4, 1), constant(4, 1))[1].any()


def test_plain_backdrop_has_nothing_to_follow():
    picture = np.full((40, 60, 3), 255, np.uint8)
    picture[10:30, 10:30] = np.random.default_rng(0).integers(90, 110, (20, 20, 3))
    ok = supported(picture)
    assert ok[10:30, 10:30].all() and not ok[:, 40:].any()


def test_vectors_scale_with_each_side():
    flow, weight = resize_flow(constant(6, 8, 20, 30), np.full((20, 30), 0.4, np.float32), 10, 10)
    assert flow.shape == (10, 10, 2)
    np.testing.assert_allclose(weight, 0.4, atol=1e-6)
    np.testing.assert_allclose(flow, np.broadcast_to(np.array([2, 4], np.float32), flow.shape), atol=1e-5)


def test_invalid_vectors_do_not_bleed():
    flow, weight = constant(2, 2, 4, 4), np.ones((4, 4), np.float32)
    flow[0, 0] = 100
    weight[0, 0] = 0
    weight[2:, 2:] = 0
    small, left = resize_flow(flow, weight, 2, 2)
    np.testing.assert_allclose(small[0, 0], [1, 1], atol=1e-5)
    np.testing.assert_array_equal(left, [[1, 1], [1, 0]])
    # nor do vectors that are less sure count as much as others
    flow, weight = constant(0, 0, 2, 2), np.full((2, 2), 0.25, np.float32)
    flow[0, 0] = 8
    weight[0, 0] = 0.75
    small, left = resize_flow(flow, weight, 1, 1)
    # the mean of 8 at 0.75 and three zeros at 0.25 is 4, halved with the size; the mean weight is 0.375
    np.testing.assert_allclose(small[0, 0], [2, 2], atol=1e-6)
    np.testing.assert_allclose(left, 0.375)


def test_same_size_changes_nothing():
    rng = np.random.default_rng(0)
    flow, weight = rng.normal(size=(9, 7, 2)).astype(np.float32), rng.random((9, 7)).astype(np.float32)
    out, left = resize_flow(flow, weight, 7, 9)
    np.testing.assert_array_equal(out, flow)
    np.testing.assert_array_equal(left, weight)
