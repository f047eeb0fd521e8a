"""How a film's time runs, in seconds of the film and times of the clip."""

import numpy as np
import pytest
from tests.refused import refused

from devrf.capture.errors import InputError
from devrf.reconstruct.film.times import TimeCurve, parse_time, picture_count

CLIP_S = 2.0


def test_real_time_shows_a_second_in_a_second() -> None:
    curve = TimeCurve(CLIP_S, speed=1.0)
    assert curve.natural_s() == CLIP_S
    count = picture_count(curve.natural_s(), 10.0, True)
    assert count == 21
    np.testing.assert_allclose(curve.times(count, 10.0), np.arange(21) / 20, atol=1e-12)


def test_slow_motion_is_longer_and_a_part_is_shorter() -> None:
    curve = TimeCurve(CLIP_S, begin=0.25, end=0.75, speed=0.25)
    assert curve.natural_s() == pytest.approx(4.0)
    times = curve.times(41, 10.0)
    assert times[0] == 0.25 and times[-1] == pytest.approx(0.75)
    np.testing.assert_allclose(np.diff(times), 0.25 / 10 / CLIP_S)


def test_slow_only_between_two_times() -> None:
    curve = TimeCurve(CLIP_S, speed=0.5, slow=(0.5, 0.75))
    assert curve.natural_s() == pytest.approx(1.0 + 1.0 + 0.5)
    times = curve.times(picture_count(curve.natural_s(), 20.0, True), 20.0)
    steps = np.diff(times) * CLIP_S * 20
    np.testing.assert_allclose(steps[:20], 1.0)
    np.testing.assert_allclose(steps[20:40], 0.5)
    np.testing.assert_allclose(steps[40:], 1.0)
    assert times[-1] == pytest.approx(1.0)


def test_there_and_back_loops_without_a_picture_twice() -> None:
    curve = TimeCurve(CLIP_S, begin=0.2, ping_pong=True)
    assert curve.natural_s() == pytest.approx(3.2)
    times = curve.times(8, 2.5)
    np.testing.assert_allclose(times, [0.2, 0.4, 0.6, 0.8, 1.0, 0.8, 0.6, 0.4])
    longer = TimeCurve(CLIP_S, speed=1.0, ping_pong=True).times(9, 1.0)  # bounces more than once
    np.testing.assert_allclose(longer, [0, 0.5, 1, 0.5, 0, 0.5, 1, 0.5, 0], atol=1e-12)


def test_a_length_without_a_speed_shows_all_of_it() -> None:
    np.testing.assert_allclose(TimeCurve(CLIP_S).times(5, 1.0), [0, 0.25, 0.5, 0.75, 1])


def test_what_is_longer_than_the_clip_is_refused() -> None:
    with refused("film-too-long", "--speed 2", "1 s", "--ping-pong", kind=InputError):
        TimeCurve(CLIP_S, speed=2.0).times(30, 10.0)


def test_times_are_shares_or_seconds() -> None:
    assert parse_time("0.25", "--time", 1.0, 3.0) == 0.25
    assert parse_time(" 1.5s", "--time", 1.0, 3.0) == 0.25
    for text in ("-0.1", "0.5s", "3.1s", "1.01"):
        with refused("option-out-of-range", f"--time {text}", "1.000s", "3.000s", kind=InputError):
            parse_time(text, "--time", 1.0, 3.0)
    for text in ("nan", "s", "soon"):
        with refused("option-malformed", f"--time {text}", kind=InputError):
            parse_time(text, "--time", 1.0, 3.0)
