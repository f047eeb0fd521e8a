"""The film's camera path stays where cameras looked from, looks at the scene and loops."""

from dataclasses import replace

import numpy as np
import pytest
from tests.reconstruct.conftest import look_at

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import to_8_bits
from devrf.reconstruct.geometry.camera_arc import film_lens, focus
from devrf.reconstruct.geometry.paths import orbit, spiral, through

AABB = np.array([[-1.0, -1, -0.8], [1, 1, 0.8]])
K = np.array([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]])


def ring(degrees, radius=3.0, height=1.0, target=(0.1, -0.1, 0.2)) -> list[Camera]:
    """Cameras at azimuths about +z, looking at `target`, z up in their pictures."""
    cameras = []
    for angle in np.radians(degrees):
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        cameras.append(replace(look_at(position, 320, 240, target), K=K))
    return cameras


def orbit_of(cameras: list[Camera], count: int, most: int = 80_000) -> list[Camera]:
    return orbit(cameras, AABB, count, film_lens(cameras, most))


def azimuths(path: list[Camera]) -> np.ndarray:
    centres = np.array([c.centre for c in path])
    return np.degrees(np.arctan2(centres[:, 1], centres[:, 0]))


def test_focus_is_where_the_axes_meet():
    np.testing.assert_allclose(focus(ring([0, 60, 120, 180]), AABB), [0.1, -0.1, 0.2], atol=0.01)
    inside = focus(ring([0, 60, 120], target=(0, 0, 5.0)), AABB)
    assert (inside >= AABB[0]).all() and (inside <= AABB[1]).all()


def test_swing_stays_within_the_cameras():
    path = orbit_of(ring([-60, -20, 25, 65]), 48)
    angle = azimuths(path)
    assert -60 <= angle.min() < -45 and 50 < angle.max() <= 65
    radius = np.array([np.linalg.norm(c.centre[:2]) for c in path])
    assert np.abs(radius - 3).max() < 0.15
    assert np.abs(np.array([c.centre[2] for c in path]) - 1).max() < 0.05


def test_full_turn_where_cameras_are_all_around():
    path = orbit_of(ring(np.arange(0, 360, 15)), 60)
    steps = np.diff(np.unwrap(np.radians(azimuths([*path, path[0]]))))
    assert steps.sum() == pytest.approx(2 * np.pi)
    assert np.abs(steps).max() < 1.3 * np.abs(steps).mean()


@pytest.mark.parametrize("degrees", [[-60, -20, 25, 65], list(range(0, 360, 20)), [170, -170], [40]])
def test_path_is_smooth_and_closed_and_looks_at_the_scene(degrees):
    cameras = ring(degrees)
    path = orbit_of(cameras, 48)
    centres = np.array([c.centre for c in [*path, path[0]]])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.max() <= 0.6  # a full turn of radius 3 in 48 steps is 0.39 each
    target = focus(cameras, AABB)
    for camera in path:
        seen = camera.project(target)
        np.testing.assert_allclose(seen, [camera.width / 2, camera.height / 2], atol=1e-6)
        assert camera.cam_from_world[1, 2] < 0  # z is up in the picture


def test_gap_across_the_back_is_left_out():
    angle = azimuths(orbit_of(ring([150, 180, -150]), 48))
    assert (np.abs(angle) >= 149).all()


def test_heights_follow_the_cameras_nearby():
    low, high = ring([-50, -40, -30], height=0.2), ring([30, 40, 50], height=2.0)
    path = orbit_of([*low, *high], 48)
    heights = np.array([c.centre[2] for c in path])
    assert 0.1 < heights.min() < 0.6 and 1.6 < heights.max() < 2.1


@pytest.mark.parametrize("most", [80_000, 20_001])
def test_size_is_even_and_within_the_limit(most):
    path = orbit_of(ring([0, 40]), 4, most)
    w, h = path[0].width, path[0].height
    assert w % 2 == 0 and h % 2 == 0 and 0.9 * min(most, 320 * 240) <= w * h <= most
    assert path[0].K[0, 0] / w == pytest.approx(300 / 320, rel=0.02)
    assert not path[0].distortion.any()


def test_pictures_are_clipped_and_rounded():
    values = np.array([[[-0.2, 0.5, 1.7]]], np.float32)
    assert to_8_bits(values).tolist() == [[[0, 128, 255]]]


def test_spiral_is_smooth_and_closed_and_looks_at_the_target():
    cameras = ring([-60, -20, 25, 65])
    path = spiral(cameras, AABB, 60, film_lens(cameras, 80_000))
    centres = np.array([c.centre for c in [*path, path[0]]])
    assert np.linalg.norm(np.diff(centres, axis=0), axis=1).max() < 0.3
    target = focus(cameras, AABB)
    for camera in path:
        np.testing.assert_allclose(camera.project(target), [camera.width / 2, camera.height / 2], atol=1e-6)
    angle = azimuths(path)
    assert np.abs(angle - 2.5).max() < 15  # about the middle of the span


def test_key_frames_are_met_as_they_are():
    views = [
        replace(c, K=c.K * [[f, 1, 1], [1, f, 1], [1, 1, 1]])
        for c, f in zip(ring([0, 40, 50]), (1, 2, 1.5), strict=True)
    ]
    path = through(views, np.array([0.0, 0.5, 1.0, 2.0]))
    for camera, view in zip((path[0], path[2], path[3]), views, strict=True):
        np.testing.assert_allclose(camera.cam_from_world, view.cam_from_world, atol=1e-9)
        np.testing.assert_allclose(camera.K, view.K)
    assert views[0].K[0, 0] < path[1].K[0, 0] < views[1].K[0, 0]
    assert through(views[:1], np.zeros(3)) == [views[0]] * 3
