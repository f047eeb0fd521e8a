"""The film's camera path stays where cameras looked from, looks at the scene and loops."""

import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.reconstruct.film import film_frames, focus, orbit

AABB = np.array([[-1.0, -1, -0.8], [1, 1, 0.8]])
K = np.array([[300.0, 0, 160], [0, 310, 120], [0, 0, 1]])


def ring(degrees, radius=3.0, height=1.0, target=(0.1, -0.1, 0.2)) -> list[Camera]:
    """Cameras at azimuths about +z, looking at `target`, z up in their pictures."""
    cameras = []
    for angle in np.radians(degrees):
        position = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        z = np.array(target) - position
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        cameras.append(Camera(320, 240, K, np.column_stack([R, -R @ position])))
    return cameras


def azimuths(path: list[Camera]) -> np.ndarray:
    centres = np.array([c.centre for c in path])
    return np.degrees(np.arctan2(centres[:, 1], centres[:, 0]))


def test_focus_is_where_the_axes_meet():
    np.testing.assert_allclose(focus(ring([0, 60, 120, 180]), AABB), [0.1, -0.1, 0.2], atol=0.01)
    inside = focus(ring([0, 60, 120], target=(0, 0, 5.0)), AABB)
    assert (inside >= AABB[0]).all() and (inside <= AABB[1]).all()


def test_swing_stays_within_the_cameras():
    path = orbit(ring([-60, -20, 25, 65]), AABB, 48, 80_000)
    angle = azimuths(path)
    assert -60 <= angle.min() < -45 and 50 < angle.max() <= 65
    radius = np.array([np.linalg.norm(c.centre[:2]) for c in path])
    assert np.abs(radius - 3).max() < 0.15
    assert np.abs(np.array([c.centre[2] for c in path]) - 1).max() < 0.05


def test_full_turn_where_cameras_are_all_around():
    path = orbit(ring(np.arange(0, 360, 15)), AABB, 60, 80_000)
    steps = np.diff(np.unwrap(np.radians(azimuths([*path, path[0]]))))
    assert steps.sum() == pytest.approx(2 * np.pi)
    assert np.abs(steps).max() < 1.3 * np.abs(steps).mean()


@pytest.mark.parametrize("degrees", [[-60, -20, 25, 65], list(range(0, 360, 20)), [170, -170], [40]])
def test_path_is_smooth_and_closed_and_looks_at_the_scene(degrees):
    cameras = ring(degrees)
    path = orbit(cameras, AABB, 48, 80_000)
    centres = np.array([c.centre for c in [*path, path[0]]])
    steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    assert steps.max() <= 0.6  # a full turn of radius 3 in 48 steps is 0.39 each
    target = focus(cameras, AABB)
    for camera in path:
        seen = camera.project(target)
        np.testing.assert_allclose(seen, [camera.width / 2, camera.height / 2], atol=1e-6)
        assert camera.cam_from_world[1, 2] < 0  # z is up in the picture


def test_gap_across_the_back_is_left_out():
    angle = azimuths(orbit(ring([150, 180, -150]), AABB, 48, 80_000))
    assert (np.abs(angle) >= 149).all()


def test_heights_follow_the_cameras_nearby():
    low, high = ring([-50, -40, -30], height=0.2), ring([30, 40, 50], height=2.0)
    path = orbit([*low, *high], AABB, 48, 80_000)
    heights = np.array([c.centre[2] for c in path])
    assert 0.1 < heights.min() < 0.6 and 1.6 < heights.max() < 2.1


@pytest.mark.parametrize("most", [80_000, 20_001])
def test_size_is_even_and_within_the_limit(most):
    path = orbit(ring([0, 40]), AABB, 4, most)
    w, h = path[0].width, path[0].height
    assert w % 2 == 0 and h % 2 == 0 and 0.9 * min(most, 320 * 240) <= w * h <= most
    assert path[0].K[0, 0] / w == pytest.approx(300 / 320, rel=0.02)
    assert not path[0].distortion.any()


def test_frames_are_clipped_and_rounded():
    def render(camera: Camera, time: float | None) -> np.ndarray:
        return np.full((camera.height, camera.width, 3), -0.2 if time is None else time, np.float32)

    path = orbit(ring([0, 40]), AABB, 3, 20_000)
    frames = list(film_frames(render, path, [None, 0.5, 1.7]))
    assert [int(f[0, 0, 0]) for f in frames] == [0, 128, 255]
