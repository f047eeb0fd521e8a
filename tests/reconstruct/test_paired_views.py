"""Differences over views: the interval of stretches of time, and what it covers where moments are alike."""

import numpy as np
import pytest
from scipy.stats import t

from devrf.reconstruct.paired_views import BLOCKS, LEAST_MOMENTS, correlation_length, gain_over_time

RNG = np.random.default_rng(0)


def courses(phi: float, length: int, count: int) -> np.ndarray:
    """Series [count, length] of mean 0 and variance 1 in which neighbours correlate by `phi` (autoregressive)."""
    noise = np.random.default_rng(1).normal(size=(count, length))
    series = [noise[:, 0]]
    for n in range(1, length):
        series.append(phi * series[-1] + np.sqrt(1 - phi**2) * noise[:, n])
    return np.stack(series, axis=1)


def moments(count: int) -> list[float]:
    return [float(n) for n in range(count)]


def test_the_interval_is_students_of_the_stretches() -> None:
    apart = RNG.normal(0.5, 1.0, 40)
    without = RNG.normal(25.0, 2.0, 40)
    gain = gain_over_time((without + apart).tolist(), without.tolist(), moments(40))
    means = apart.reshape(BLOCKS, 10).mean(1)
    assert gain.mean == pytest.approx(apart.mean())
    assert gain.half == pytest.approx(
        t.ppf(0.975, BLOCKS - 1) * means.std(ddof=1) / np.sqrt(BLOCKS)
    )  # by hand
    assert gain.by_pair == pytest.approx(means)


def test_the_order_of_the_views_does_not_count_but_their_time_does() -> None:
    values = courses(0.5, 40, 1)[0]
    mixed = RNG.permutation(40)
    one = gain_over_time(values.tolist(), [0.0] * 40, moments(40))
    other = gain_over_time(values[mixed].tolist(), [0.0] * 40, mixed.astype(float).tolist())
    assert other.half == pytest.approx(one.half) and other.mean == pytest.approx(one.mean)


def test_cameras_of_one_moment_stand_together() -> None:
    """A camera that is always better is no proof of change over time, and no reason for a shorter interval."""
    values = courses(0.5, 24, 1)[0]
    one = gain_over_time(values.tolist(), [0.0] * 24, moments(24))
    both = np.stack([values - 3, values + 3], axis=1).ravel()
    two = gain_over_time(both.tolist(), [0.0] * 48, np.repeat(moments(24), 2).tolist(), cameras=2)
    assert two.mean == pytest.approx(one.mean) and two.half == pytest.approx(one.half)


@pytest.mark.parametrize("phi", [0.0, 0.5, 0.8])
def test_it_covers_what_it_claims_where_moments_are_alike(phi: float) -> None:
    """Of 600 clips of 40 pictures without a difference; taken for independent, 95 % would be 48 % at phi = 0.8."""
    found = [gain_over_time(c.tolist(), [0.0] * 40, moments(40)) for c in courses(phi, 40, 600)]
    judged = [gain for gain in found if gain.half is not None]
    right = np.mean([gain.side() == 0 for gain in judged])
    assert len(judged) > 500
    assert 0.86 < right < 0.98


def test_a_difference_that_drifts_through_the_whole_clip_is_not_judged() -> None:
    gain = gain_over_time(np.linspace(0.0, 1.0, 40).tolist(), [0.0] * 40, moments(40))
    assert gain.half is None and gain.side() == 0 and gain.mean == pytest.approx(0.5)


def test_few_moments_are_not_judged_and_equal_models_do_not_differ() -> None:
    few = LEAST_MOMENTS - 1
    assert gain_over_time([1.0] * few, [0.0] * few, moments(few)).half is None
    same = gain_over_time([1.0] * 20, [1.0] * 20, moments(20))
    assert same.nothing and same.half == 0.0 and same.side() == 0


def test_values_without_partner_or_time_are_refused() -> None:
    for arguments in (([], [], []), ([1.0], [1.0, 2.0], [0.0]), ([1.0], [1.0], [])):
        with pytest.raises(ValueError, match="do not belong together"):
            gain_over_time(*arguments)


def test_the_correlation_length_of_known_series() -> None:
    assert correlation_length(np.ones(9)) == 1.0
    long = courses(0.9, 20_000, 1)[0]
    assert correlation_length(long) == pytest.approx((1 + 0.9) / (1 - 0.9), rel=0.2)  # of such a series
    assert correlation_length(courses(0.0, 20_000, 1)[0]) == pytest.approx(1.0, abs=0.2)
