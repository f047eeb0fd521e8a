"""Steady light: what is found in the light of a clip, and the gains that take it out."""

import numpy as np
import pytest
from jaxtyping import Float
from tests.make.pictures import Pictures, course_of, film_of_room

from devrf.calibration.colour.flicker import EXPOSURE_STOPS, judge_light, steady_gains
from devrf.capture.colour.srgb import LINEAR_OF_LEVEL

FPS = 29.97
FRAMES = 120


def spread(pictures: Pictures, gains: Float[np.ndarray, "n 3"]) -> float:
    """RMS over frames and channels of the wall's light against its mean (its left columns, before nothing moves)."""
    light = np.array([LINEAR_OF_LEVEL[p[:30]].mean(axis=(0, 1)) for p in pictures]) * gains
    return float((light / light.mean(axis=0)).std())


TIME_S = np.arange(FRAMES) / FPS


def test_a_steady_clip_is_left_alone():
    pictures = film_of_room(np.ones((FRAMES, 1, 3)))
    course = course_of(pictures, TIME_S)
    assert judge_light(course).steady
    assert steady_gains(course) is None


def test_a_lamp_seen_at_half_the_frame_rate():
    """120 Hz at 16 frames a second is seen at 8 Hz, as is what a codec does to every other frame."""
    time_s = np.arange(FRAMES) / 16
    for depth, fires in ((0.003, False), (0.05, True)):
        light = 1 + depth / 2 * np.cos(2 * np.pi * 120 * time_s)
        found = judge_light(course_of(film_of_room(light[:, None, None] * np.ones(3)), time_s)).flicker
        assert (found is not None) == fires
        # what lies between the two frames of a wave is not seen: a wave of sqrt(2) fits as well
        if found is not None:
            assert 0.95 * depth < found.depth < 1.05 * np.sqrt(2) * depth


def test_automatic_exposure():
    stops = 0.4 * np.clip((TIME_S - 1.0) / 1.5, 0, 1)
    pictures = film_of_room(np.exp2(stops)[:, None, None] * np.ones(3))
    course = course_of(pictures, TIME_S)
    found = judge_light(course)
    assert found.exposure is not None and found.colour is None and found.flicker is None
    # 0.003 stops by the derivation in test_light.py, at both ends; the ramp's ends are a tenth of it inside.
    assert found.exposure.stops == pytest.approx(0.4, abs=0.006)
    assert found.exposure.from_s == pytest.approx(1.15, abs=0.1)
    assert found.exposure.to_s == pytest.approx(2.35, abs=0.1)
    gains = steady_gains(course)
    assert gains is not None
    np.testing.assert_array_equal(gains[:, :1].repeat(3, axis=1), gains)  # the exposure alone changes
    # What is left is the measure's own error, 0.2 %; before it is the ramp itself.
    before, after = spread(pictures, np.ones((FRAMES, 3))), spread(pictures, gains)
    assert before > 0.1 and after < 0.003


def test_darkening_and_short_passers_by():
    stops = np.where(TIME_S > 2, -0.2, 0.0)
    stops[30:33] = 1.0  # a flash of three frames is no change of exposure
    found = judge_light(course_of(film_of_room(np.exp2(stops)[:, None, None] * np.ones(3)), TIME_S)).exposure
    assert found is not None and found.stops == pytest.approx(-0.2, abs=0.006)
    assert found.from_s == pytest.approx(2.0, abs=0.1) and found.to_s == pytest.approx(2.0, abs=0.1)


def test_automatic_white_balance():
    tint = np.clip(TIME_S - 2.0, 0, 1)[:, None] * np.array([0.1, 0.0, -0.16])
    pictures = film_of_room(np.exp2(tint)[:, None])
    course = course_of(pictures, TIME_S)
    found = judge_light(course)
    assert found.colour is not None and found.colour.stops == pytest.approx(-0.16, abs=0.006)
    assert found.exposure is None  # the mean of the three changes by 0.02 stops
    assert found.left < EXPOSURE_STOPS
    gains = steady_gains(course)
    assert gains is not None and spread(pictures, gains) < 0.003


def test_what_gains_leave_of_light_that_changes_from_place_to_place():
    """A lamp that sinks: what falls down the picture by 0.4 stops differs from its middle by 0.1 in the median."""
    falls = np.linspace(-0.2, 0.2, 12) * np.clip(TIME_S - 2.0, 0, 1)[:, None]
    found = judge_light(
        course_of(film_of_room(np.exp2(falls - 0.5 * (falls != 0))[..., None] * np.ones(3)), TIME_S)
    )
    assert found.exposure is not None and found.left == pytest.approx(0.1, abs=0.036)  # between rows


@pytest.mark.parametrize(("lamp_hz", "fps"), [(100.0, 29.97), (120.0, 25.0), (100.2, 24.0)])
def test_mains_flicker(lamp_hz, fps):
    time_s = np.arange(FRAMES) / fps
    light = 1 + 0.05 * np.sin(2 * np.pi * lamp_hz * time_s)  # all rows at once
    pictures = film_of_room(light[:, None, None] * np.ones(3))
    course = course_of(pictures, time_s)
    found = judge_light(course)
    assert found.flicker is not None
    # 1.05 / 0.95 - 1. A frame errs by 0.003 stops (test_light.py), 4 % of the wave's 0.07.
    assert found.flicker.depth == pytest.approx(0.105, rel=0.05)
    alias_hz = abs(lamp_hz - fps * round(lamp_hz / fps))
    assert found.flicker.seen_hz == pytest.approx(alias_hz, abs=0.1 * fps / FRAMES)
    assert found.exposure is None
    gains = steady_gains(course)
    assert gains is not None
    assert spread(pictures, np.ones((FRAMES, 3))) > 0.03 and spread(pictures, gains) < 0.003


def test_flicker_of_a_rolling_shutter_is_seen_in_bands():
    rows_s = np.arange(120) / 120 * 0.02  # two whole waves of 100 Hz: the mean over the picture stays
    light = 1 + 0.05 * np.sin(2 * np.pi * 100 * (TIME_S[:, None] + rows_s))
    course = course_of(film_of_room(light[:, :, None] * np.ones(3)), TIME_S)
    found = judge_light(course)
    # 0.05 if all rows had it at once; the square hides some rows more than others
    assert course.stops.std() < 0.02
    # A band averages a sixth of a wave: sinc(1/6) = 0.955; and 5 % as above.
    assert found.flicker is not None and found.flicker.depth == pytest.approx(0.955 * 0.105, rel=0.05)


def test_frames_that_are_not_known_follow_their_neighbours():
    stops = np.linspace(0, 0.6, FRAMES)
    course = course_of(film_of_room(np.exp2(stops)[:, None, None] * np.ones(3)), TIME_S)
    whole = steady_gains(course)
    course.stops[50:60] = np.nan
    gains = steady_gains(course)
    assert whole is not None and gains is not None
    np.testing.assert_allclose(gains, whole, rtol=2 * 0.003)
    course.stops[20:110] = np.nan
    assert steady_gains(course) is None
