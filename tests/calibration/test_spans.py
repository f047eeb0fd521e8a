"""When cameras film together, and which of them."""

import numpy as np
import pytest

from devrf.calibration.clocks.spans import most_together, span_of


@pytest.mark.parametrize(
    ("filmed", "expected"),
    [
        # the first alone films from 0 to 1, the last from 6 to 7
        ([(0.0, 5.0), (1.0, 6.0), (2.0, 7.0)], (1.0, 6.0)),
        ([(0.0, 5.0), (6.0, 9.0)], None),
        ([(0.0, 5.0), (5.0, 9.0)], None),
        ([(3.0, 5.0)], (3.0, 5.0)),
        ([(0.0, 1.0), (0.5, 2.0), (5.0, 7.0), (6.0, 8.0)], (0.5, 7.0)),
        ([], None),
    ],
)
def test_time_that_is_modelled(filmed, expected) -> None:
    assert span_of(filmed) == expected


@pytest.mark.parametrize(
    ("filmed", "expected"),
    [
        ({"a": (0, 2), "b": (0, 2), "late": (2.5, 4.5)}, ["a", "b"]),
        ({"late": (2.5, 4.5), "a": (0, 2), "b": (1, 2)}, ["a", "b"]),
        ({"a": (0, 2), "b": (0.5, 3), "c": (1, 4)}, ["a", "b", "c"]),
        # all share half a second, which is too short
        ({"a": (0, 2), "b": (0, 3), "c": (1.5, 5)}, ["a", "b"]),
        ({"a": (0, 2), "b": (0.5, 5), "c": (1.5, 5)}, ["b", "c"]),
        # of two pairs the one that films longer together
        ({"a": (0, 2), "b": (0, 2), "c": (3, 6), "d": (3, 6)}, ["c", "d"]),
        ({"a": (0, 2), "b": (3, 4)}, []),
        ({"a": (0, 2)}, []),
        ({}, []),
    ],
)
def test_as_many_cameras_as_film_together(
    filmed: dict[str, tuple[float, float]], expected: list[str]
) -> None:
    """Ten pictures a second; ten are enough."""
    times = {name: np.arange(10 * begin, 10 * end + 1) / 10 for name, (begin, end) in filmed.items()}
    assert most_together(times, 10) == expected


def test_a_camera_with_too_few_pictures_does_not_count() -> None:
    times = {name: np.arange(0, 2, step) for name, step in (("a", 0.1), ("slow", 0.5), ("b", 0.1))}
    assert most_together(times, 10) == ["a", "b"]
