"""Differences of pairs, and over views: the interval of stretches, and what it covers where moments are alike."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_rel

from devrf.reconstruct.evaluation.paired import LEAST_MOMENTS, STRETCHES, Gain, gain_over_time, paired_gain

RNG = np.random.default_rng(0)


def courses(phi: float, length: int, count: int) -> np.ndarray:
    """Series [count, length] of mean 0 and variance 1 in which neighbours correlate by `phi` (autoregressive)."""
    noise = np.random.default_rng(1).normal(size=(count, length))
    series = [noise[:, 0]]
    for n in range(1, length):
        series.append(phi * series[-1] + np.sqrt(1 - phi**2) * noise[:, n])
    return np.stack(series, axis=1)


def gain(values: np.ndarray, times: np.ndarray | None = None) -> Gain:
    order = np.arange(len(values)) if times is None else times
    return gain_over_time(values.tolist(), [0.0] * len(values), order.tolist())


def test_the_interval_is_students_of_the_stretches() -> None:
    apart = RNG.normal(0.5, 1.0, 40)
    means = apart.reshape(STRETCHES, 10).mean(1)
    low, high = ttest_1samp(means, 0.0).confidence_interval(0.95)
    found = gain(apart)
    assert found.mean == pytest.approx(apart.mean()) and found.by_pair == pytest.approx(means)
    assert found.half == pytest.approx((high - low) / 2)


def test_the_order_of_the_views_does_not_count_but_their_time_does() -> None:
    values, mixed = courses(0.5, 40, 1)[0], RNG.permutation(40)
    assert gain(values[mixed], mixed).half == pytest.approx(gain(values).half)


def test_cameras_of_one_moment_stand_together() -> None:
    """A camera that is always better is no proof of change over time, and no reason for a shorter interval."""
    values = courses(0.5, 24, 1)[0]
    both = np.stack([values - 3, values + 3], axis=1).ravel()
    assert gain(both, np.repeat(np.arange(24), 2)).half == pytest.approx(gain(values).half)


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_it_covers_what_it_claims_where_moments_are_alike(phi: float) -> None:
    """Of 600 clips of 40 pictures without a difference; taken for independent, 95 % would be 48 % at phi = 0.8."""
    right = np.mean([gain(values).side() == 0 for values in courses(phi, 40, 600)])
    assert 0.86 < right < 0.98


def test_few_moments_are_not_judged_and_equal_models_do_not_differ() -> None:
    few = gain(np.ones(2 * LEAST_MOMENTS), np.arange(2 * LEAST_MOMENTS) % (LEAST_MOMENTS - 1))
    assert few.half is None and few.side() == 0
    same = gain(np.zeros(20))
    assert same.nothing and same.half == 0.0 and same.side() == 0


def test_the_interval_of_pairs_is_students() -> None:
    gain = paired_gain([3.0, 5.0, 7.0], [2.0, 3.0, 4.0])  # 1, 2, 3: mean 2, deviation 1
    assert (gain.mean, gain.by_pair) == (2.0, (1.0, 2.0, 3.0))
    two_degrees_of_freedom = 4.302653  # Student's t at 97.5 %
    assert gain.half == pytest.approx(two_degrees_of_freedom / np.sqrt(3), rel=1e-6)
    assert gain.side() == 0 and not gain.nothing
    rng = np.random.default_rng(0)
    a, b = rng.normal(1.0, 1.0, 5).tolist(), rng.normal(0.0, 1.0, 5).tolist()
    interval = ttest_rel(a, b).confidence_interval(0.95)
    gain = paired_gain(a, b)
    assert gain.half is not None
    assert (gain.mean - gain.half, gain.mean + gain.half) == pytest.approx((interval.low, interval.high))


def test_signs_of_gains() -> None:
    assert paired_gain([1.0, 1.1], [0.0, 0.1]).side() == 1
    assert paired_gain([0.0, 0.1], [1.0, 1.1]).side() == -1
    assert paired_gain([1.0, 2.0], [1.0, 2.0]).nothing
    one = paired_gain([5.0], [1.0])
    assert one.half is None and one.side() == 0
    with pytest.raises(ValueError, match="2 and 1"):
        paired_gain([1.0, 2.0], [1.0])
    with pytest.raises(ValueError, match="0 and 0"):
        paired_gain([], [])
