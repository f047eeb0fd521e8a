"""Where view axes meet, and what lies behind cameras."""

from dataclasses import replace

import numpy as np

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.view_axes import behind, closest_point


def turned(camera: Camera) -> Camera:
    """The camera with y and z the other way round, as if OpenGL's axes were taken for OpenCV's."""
    return replace(camera, cam_from_world=np.diag([1.0, -1.0, -1.0]) @ camera.cam_from_world)


def test_closest_point_of_lines_that_meet() -> None:
    target = np.array([0.3, -0.2, 1.0])
    centres = np.random.default_rng(0).normal(size=(5, 3))
    rays = (target - centres) / np.linalg.norm(target - centres, axis=1, keepdims=True)
    np.testing.assert_allclose(closest_point(centres, rays), target, atol=1e-12)


def test_turned_axes_put_everything_behind(odd_scene: Scene) -> None:
    cameras, points = [f.camera for f in odd_scene.static], odd_scene.points
    assert points is not None
    assert behind(cameras, None) == behind(cameras, points) == 0
    for n in range(len(cameras)):  # one after the other
        cameras[n] = turned(cameras[n])
        # every point is seen by every camera
        assert np.isclose(behind(cameras, points), (n + 1) / len(cameras))
        assert np.isclose(behind(cameras, None), (n + 1) / len(cameras))
