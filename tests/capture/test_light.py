"""Light of a clip over time: what is measured on the background, whatever moves before it."""

import numpy as np
import pytest
from tests.make.pictures import Pictures, course_of, film_of_room, levels_of, room
from tests.refused import refused

from devrf.capture.colour.light_course import BANDS, LightCourse, clipped_share, highlight_faults
from devrf.capture.ingest.extract_clip import Keep, extract_clip
from devrf.capture.photos.extract import extract_folder
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.system.errors import CaptureError

# A cell is the mean of 25 pixels (here), the course the median of some 400 cells. With noise of one level (0.9 % of the
# light at mid grey) and rounding (0.3 levels), a cell errs by 0.3 %, their median by 1.25 * 0.3 % / sqrt(400) = 0.02 %,
# twice that as a ratio of two frames. What moves shifts the median by at most the share of cells it covers, times the
# spread of the cells that agree: 0.3 * 0.3 %. Together less than 0.2 %, 0.003 stops.
MEASURED_STOPS = 0.003
CELL_STOPS = 0.02  # a dark cell at half the light errs by 1 % in each of two frames, with rounding


def film(light: np.ndarray) -> Pictures:
    """The square covers a fifth."""
    return film_of_room(light[:, None], square=64)


def test_gains_are_measured_on_the_background():
    rng = np.random.default_rng(1)
    light = np.exp2(rng.uniform(-0.7, 0.7, (20, 3)))
    light[0] = 1
    course = course_of(film(light))
    np.testing.assert_allclose(course.stops, np.log2(light), atol=3 * MEASURED_STOPS)
    steady = course_of(film(np.ones((20, 3))))
    np.testing.assert_allclose(steady.stops, 0, atol=MEASURED_STOPS)
    np.testing.assert_allclose(np.nanmedian(steady.bands), 0, atol=MEASURED_STOPS)


def test_bands():
    rng = np.random.default_rng(2)
    wall = room(rng)
    gain = np.exp2(np.linspace(-0.1, 0.1, 120))[:, None, None]  # light falls as the sensor reads down
    pictures = [levels_of(scene) for scene in (wall, wall * gain)]
    bands = course_of(pictures).bands[1]
    middles = (np.arange(BANDS) + 0.5) / BANDS * 0.2 - 0.1
    # The steepest change within a band is 0.2 / 12 stops; a median of its two rows of cells lies within half of it.
    np.testing.assert_allclose(bands, middles, atol=0.1 / BANDS + MEASURED_STOPS)


def test_what_one_gain_leaves():
    """Little of one gain for all, though something moves; of light that falls down a picture a quarter of the range."""
    even = course_of(film(np.exp2([[0.0], [0.5], [-1.0]]) * np.ones(3)))
    assert np.all(even.left < CELL_STOPS)
    wall = room(np.random.default_rng(2))
    gain = np.exp2(np.linspace(-0.1, 0.1, 120))[:, None, None]
    pictures = [levels_of(scene) for scene in (wall, wall * gain)]
    assert course_of(pictures).left[1] == pytest.approx(0.2 / 4, abs=CELL_STOPS)


def test_not_known_where_the_subject_fills_the_picture():
    rng = np.random.default_rng(3)
    pictures = [levels_of(room(rng)) for _ in range(3)]
    course = course_of(pictures)
    assert np.isfinite(course.stops[0]).all() and np.isnan(course.stops[1:]).all()
    black = course_of([np.zeros((60, 80, 3), np.uint8)] * 2)
    assert np.isnan(black.stops).all()


def test_clipped_share():
    picture = np.full((100, 160, 3), 90, np.uint8)
    assert clipped_share(picture) == 0 and highlight_faults([]) == []
    picture[:25, :, 0] = 255  # one channel is enough
    assert clipped_share(picture) == 0.25
    assert highlight_faults([0.005, 0.009, 0.5]) == []  # a reflection that passes by
    (fault,) = highlight_faults([0.05, 0.06, 0.07])
    assert fault.code == "highlights" and str(fault.value).startswith("6 %")


@pytest.mark.parametrize("role", ["sweep", "camera", "board"])
def test_clipped_clips_and_photos_are_named(make_clip, tmp_path, role):
    picture = levels_of(room(np.random.default_rng(4)))
    picture[:40] = 255
    clip = make_clip("a.mp4", [picture] * 3)
    got = extract_clip(clip, tmp_path / "out", "cam0", role, "a.mp4", Keep()).frames
    (tmp_path / "in").mkdir()
    write_picture(tmp_path / "in" / "0.png", picture)
    photos = extract_folder(tmp_path / "in", tmp_path / "out", "static", role, "in")
    for found in (got, photos) if role == "sweep" else (got,):
        texts = [str(fault.value) for fault in found.faults if fault.code == "highlights"]
        assert bool(texts) == (role != "board") and all(text.startswith("33 %") for text in texts)


def test_file(tmp_path):
    course = course_of(film(np.ones((3, 3))))
    course.write(tmp_path / "cam0.npy")
    again = LightCourse.read(tmp_path / "cam0.npy")
    for name in ("index", "time_s", "stops", "left", "bands"):
        np.testing.assert_array_equal(getattr(again, name), getattr(course, name))
    np.save(tmp_path / "cam1.npy", np.zeros((3, 2)))
    for name in ("cam1.npy", "cam2.npy"):
        with refused("file-damaged", name, "--from ingest", kind=CaptureError):
            LightCourse.read(tmp_path / name)
