"""What a film shows: the points that move, the moment that tells most, a way on which nothing near hides them."""

import numpy as np
import pytest
from tests.make.models import RADIUS, SLAB, TRAVEL, moving_ball, moving_parts
from tests.make.models import outside as outside_of
from tests.reconstruct.conftest import look_at

from devrf.capture.camera import Camera
from devrf.reconstruct.film import subject as film_subject
from devrf.reconstruct.film.subject import Subject, clear_orbit, hidden, subject_of
from devrf.reconstruct.geometry.camera_arc import film_lens
from devrf.reconstruct.geometry.paths import orbit
from devrf.reconstruct.rendering.model import DynamicModel

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def ring(degrees: list[float], away: float = 2.5) -> list[Camera]:
    angles = np.radians(degrees)
    return [
        look_at(np.array([away * np.cos(a), away * np.sin(a), 0.6]), 160, 120, (0.0, 0.0, 0.0))
        for a in angles
    ]


def test_the_ball_moves_and_is_followed() -> None:
    found = subject_of(moving_ball(), ring([-40, 0, 40]))
    assert found is not None
    away = np.linalg.norm(found.ways - found.times[:, None, None] * [TRAVEL, 0, 0], axis=-1)
    assert len(away[0]) > 50 and np.abs(away - RADIUS).max() < 0.06
    assert found.telling == 1.0  # it never slows down


def test_what_stands_is_no_part_of_it() -> None:
    model = moving_parts()
    found = subject_of(model, ring([-60, 0, 60]))
    assert found is not None
    assert (outside_of(SLAB, found.ways[6].reshape(-1, 3), 0.5) > -0.02).all()
    assert subject_of(DynamicModel(model.rest), ring([0])) is None


@pytest.mark.parametrize("front", [False, True])
def test_things_in_between_hide_it(front: bool) -> None:
    """Surroundings that are solid all around the box."""
    model = moving_ball("shell")
    found = subject_of(model, ring([-40, 0, 40]))
    shell = model.rest.shell
    assert found is not None and shell is not None
    camera = ring([0], away=4.0)[0]
    assert hidden(model, camera, found) == 0.0
    if front:
        shell.grid[..., 0] = 60.0  # all of the surroundings is solid
        shell.rebuild_occupancy()
        assert hidden(model, camera, found) == 1.0


def test_the_slab_hides_the_ball_from_below_only_where_it_is_near() -> None:
    model = moving_parts()
    ball = np.array([[[0.4, 0.0, -0.25]]])
    subject = Subject(np.array([0.5]), ball, 0.5)
    near, far = (look_at(np.array([0.4, 0.01, z]), 160, 120, (0.4, 0.0, -0.25)) for z in (-1.05, -2.5))
    assert hidden(model, near, subject) == 1.0 and hidden(model, far, subject) == 0.0


def test_the_way_keeps_to_where_it_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """From 20 degrees on a shelf stands in the way, which a camera at less than 0.8 of the distance has passed."""
    model, cameras = moving_ball(), ring([-60, -20, 20, 60])
    found, lens = subject_of(model, cameras), film_lens(cameras, 4000)
    assert found is not None
    plain = orbit(cameras, BOX, 24, lens)

    def azimuth(path: list[Camera]) -> np.ndarray:
        return np.degrees([np.arctan2(c.centre[1], c.centre[0]) for c in path])

    def behind(passable: bool, _: DynamicModel, camera: Camera, *more: object) -> float:
        covered = azimuth([camera])[0] > 20
        return float(covered and not (passable and np.linalg.norm(camera.centre) < 0.8 * 2.57))

    same = clear_orbit(model, cameras, BOX, 24, lens, found)
    np.testing.assert_array_equal(azimuth(same), azimuth(plain))
    monkeypatch.setattr(film_subject, "hidden", lambda *a: behind(False, *a))
    kept = azimuth(clear_orbit(model, cameras, BOX, 24, lens, found))
    assert kept.max() <= 21 and kept.min() == pytest.approx(azimuth(plain).min(), abs=1)
    assert np.abs(np.diff(kept)).max() < 12
    monkeypatch.setattr(film_subject, "hidden", lambda *a: behind(True, *a))
    passed = clear_orbit(model, cameras, BOX, 24, lens, found)
    assert azimuth(passed).max() == pytest.approx(azimuth(plain).max(), abs=1)
    assert all(behind(True, model, camera) == 0 for camera in passed)
    monkeypatch.setattr(film_subject, "hidden", lambda *a: 1.0)
    np.testing.assert_array_equal(azimuth(clear_orbit(model, cameras, BOX, 24, lens, found)), azimuth(plain))


def test_a_closed_way_swings_where_it_is_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    model, cameras = moving_ball(), ring(list(range(0, 360, 20)))
    found, lens = subject_of(model, cameras), film_lens(cameras, 4000)
    assert found is not None

    def behind(_: DynamicModel, camera: Camera, *more: object) -> float:
        return float(camera.centre[0] < -0.5 * np.linalg.norm(camera.centre))

    monkeypatch.setattr(film_subject, "hidden", behind)
    path = clear_orbit(model, cameras, BOX, 60, lens, found)
    places = np.array([c.centre for c in path])
    assert (places[:, 0] > -1.4).all() and np.ptp(places[:, 1]) > 4
    assert np.linalg.norm(np.diff([*places, places[0]], axis=0), axis=1).max() < 0.7
