"""Pictures come at once, in the size that there is time for."""

import pytest

from devrf.pipelines.viewer.progressive import FEWEST, FIRST, MOVING_S, at_most, in_time


@pytest.mark.parametrize("overhead_s", [0.0, 0.05])
@pytest.mark.parametrize("rate", [2e4, 2e5, 2e6])
def test_pace_settles_where_pictures_are_in_time(rate: float, overhead_s: float) -> None:
    budget = FIRST
    for _ in range(40):
        budget = in_time(budget, round(budget), overhead_s + budget / rate)
    assert overhead_s + budget / rate == pytest.approx(MOVING_S, rel=0.2)


def test_one_slow_picture_does_not_make_the_next_ones_tiny() -> None:
    budget = in_time(FIRST, int(FIRST), 30.0)
    assert budget > 0.6 * FIRST
    for _ in range(50):
        budget = in_time(budget, 10, 30.0)
    assert budget == FEWEST


def test_the_largest_picture_keeps_its_shape() -> None:
    assert at_most(640, 360, 10**6) == (640, 360) and at_most(3, 2, 1.0) == (2, 2)
    width, height = at_most(3840, 2160, 1280 * 720)
    assert width * height <= 1280 * 720 < 1.01 * width * height
    assert width / height == pytest.approx(16 / 9, rel=0.01)
