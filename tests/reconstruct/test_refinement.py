"""Pictures come at once, in the size that there is time for, and end whole."""

import pytest

from devrf.reconstruct.refinement import FEWEST, MOVING_S, Pace, at_most, at_size, next_size


@pytest.mark.parametrize("overhead_s", [0.0, 0.05])
@pytest.mark.parametrize("rate", [2e4, 2e5, 2e7])
def test_pace_settles_where_pictures_are_in_time(rate: float, overhead_s: float) -> None:
    pace, whole = Pace(), 1280 * 720

    def took_s(halvings: int) -> float:
        width, height = at_size(1280, 720, halvings)
        return overhead_s + width * height / rate

    for _ in range(20):
        halvings = pace.first(whole)
        pace.note(round(whole / 2**halvings), took_s(halvings))
    settled = pace.first(whole)
    assert took_s(settled) < 1.6 * MOVING_S
    assert settled == 0 or took_s(settled - 2) > MOVING_S  # it could not have been much larger


def test_one_slow_picture_does_not_make_the_next_ones_tiny() -> None:
    pace = Pace()
    before = pace.budget
    pace.note(int(before), 30.0)
    assert pace.budget > 0.6 * before
    for _ in range(50):
        pace.note(10, 30.0)
    assert at_size(1280, 720, pace.first(1280 * 720))[0] > (FEWEST / 2) ** 0.5


def test_refining_ends_with_the_whole_picture() -> None:
    halvings, sizes = 9, []
    while halvings:
        sizes.append(at_size(1000, 500, halvings))
        halvings = next_size(halvings)
    sizes.append(at_size(1000, 500, halvings))
    assert sizes == [(44, 22), (88, 44), (177, 88), (354, 177), (707, 354), (1000, 500)]
    assert at_size(3, 2, 30) == (2, 2)


def test_the_largest_picture_keeps_its_shape() -> None:
    assert at_most(640, 360, 10**6) == (640, 360)
    width, height = at_most(3840, 2160, 1280 * 720)
    assert width * height <= 1280 * 720 < 1.01 * width * height
    assert width / height == pytest.approx(16 / 9, rel=0.01)
