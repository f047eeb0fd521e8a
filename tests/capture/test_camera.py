"""The camera against closed forms, OpenCV's own projection, and invariances."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats

from devrf.capture.camera import Camera, distort, distort_many, undistort

K = np.array([[500.0, 0, 310.5], [0, 480.0, 243.0], [0, 0, 1]])
LENS = np.array([-0.3, 0.12, 0.002, -0.001, -0.02])


def test_focal_lengths_are_positive():
    with pytest.raises(ValueError, match="focal lengths -5, 1, expected more than 0"):
        Camera(4, 4, np.diag([-5.0, 1.0, 1.0]), np.eye(3, 4))


def pose(rotvec, centre) -> np.ndarray:
    R = cv2.Rodrigues(np.asarray(rotvec, dtype=np.float64))[0]
    return np.column_stack([R, -R @ np.asarray(centre, dtype=np.float64)])


FISHEYE = np.array([0.05, -0.01, 0.003, -0.0005, 0.0])
PLAIN = Camera(640, 480, K, pose([0.2, -0.4, 0.1], [0.3, -1.0, -3.0]), LENS)
WIDE = replace(PLAIN, distortion=FISHEYE, model="OPENCV_FISHEYE")
CAMERAS = pytest.mark.parametrize(("camera", "widest_deg"), [(PLAIN, 15), (WIDE, 80)])


def points(widest_deg: float = 15) -> np.ndarray:
    """World points up to so many degrees from the axis of the cameras."""
    rng = np.random.default_rng(4)
    theta, phi = np.radians(rng.uniform(0, widest_deg, 200)), rng.uniform(0, 2 * np.pi, 200)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    return PLAIN.centre + 2 * rays @ PLAIN.cam_from_world[:, :3]


def test_points_on_the_axis_land_on_the_principal_point_and_behind_the_camera_nowhere():
    axis = PLAIN.cam_from_world[2, :3]
    np.testing.assert_allclose(PLAIN.project(PLAIN.centre + 2 * axis), [310.5, 243.0], atol=1e-9)
    assert np.isnan(PLAIN.project(PLAIN.centre - axis)).all()


@CAMERAS
def test_projection_agrees_with_opencv_up_to_its_half_pixel(camera: Camera, widest_deg: float):
    k_cv = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    rvec, tvec = cv2.Rodrigues(camera.cam_from_world[:, :3])[0], camera.cam_from_world[:, 3]
    seen = points(widest_deg)
    if camera is WIDE:
        theirs = cv2.fisheye.projectPoints(seen[:, None], rvec, tvec, k_cv, FISHEYE[:4])[0]
    else:
        theirs = cv2.projectPoints(seen, rvec, tvec, k_cv, LENS)[0]
    np.testing.assert_allclose(camera.project(seen), theirs.reshape(-1, 2) + 0.5, atol=1e-8)


@CAMERAS
def test_directions_invert_projection(camera: Camera, widest_deg: float):
    truth = points(widest_deg) - camera.centre
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    np.testing.assert_allclose(camera.directions(camera.project(points(widest_deg))), truth, atol=1e-9)


def test_directions_of_a_fisheye_go_on_beyond_90_degrees():
    """Without distortion a picture radius of f x 100 degrees is 100 degrees from the axis."""
    ideal = Camera(640, 480, np.diag([200.0, 200.0, 1.0]), np.eye(3, 4), np.zeros(5), "OPENCV_FISHEYE")
    angle = np.radians(100)
    seen = ideal.directions(np.array([[200 * angle, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(seen, [[np.sin(angle), 0, np.cos(angle)], [0, 0, 1]], atol=1e-12)


@given(arrays(float, 5, elements=floats(-1, 1)), arrays(float, (4, 2), elements=floats(-0.6, 0.6)))
def test_undistort_inverts_distort(share, x):
    """All lenses of up to the strongest here, and fisheyes as far from the axis as they see."""
    lens = share * LENS
    np.testing.assert_allclose(undistort(distort(x, lens), lens), x, atol=1e-8)
    lens = share * FISHEYE
    there = distort(5 * x, lens, "OPENCV_FISHEYE")
    np.testing.assert_allclose(undistort(there, lens, "OPENCV_FISHEYE"), 5 * x, atol=1e-8)


def test_many_lenses_at_once_distort_as_one_by_one():
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (6, 2))
    fisheye = np.arange(6) % 2 == 0
    lenses = np.where(fisheye[:, None], FISHEYE, LENS)
    expected = [distort(x[n], lenses[n], "OPENCV_FISHEYE" if fisheye[n] else "OPENCV") for n in range(len(x))]
    np.testing.assert_allclose(distort_many(x, lenses, fisheye), expected, atol=1e-15)


@given(floats(0.1, 3.0))
def test_scaled_camera_sees_scaled_pixels(scale):
    small = PLAIN.scaled(scale)
    ratio = np.array([small.width / PLAIN.width, small.height / PLAIN.height])
    np.testing.assert_allclose(small.project(points()), PLAIN.project(points()) * ratio, atol=1e-9)


@given(floats(0.1, 10), arrays(float, 3, elements=floats(-3, 3)), arrays(float, 3, elements=floats(-3, 3)))
def test_moving_the_world_and_the_camera_together_changes_no_pixel(scale, turn, shift):
    similarity = np.eye(4)
    similarity[:3, :3], similarity[:3, 3] = scale * cv2.Rodrigues(turn)[0], shift
    moved = points() @ similarity[:3, :3].T + shift
    np.testing.assert_allclose(PLAIN.moved(similarity).project(moved), PLAIN.project(points()), atol=1e-7)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"cam_from_world": np.diag([1.0, 1, -1, 1])[:3]}, "rigid"),
        ({"K": np.full((3, 3), np.nan)}, "finite"),
        ({"distortion": np.zeros(4)}, "shape"),
        ({"width": 0}, "size"),
    ],
)
def test_impossible_cameras_are_refused(change, word):
    good = {"width": 640, "height": 480, "K": K, "cam_from_world": np.eye(4)[:3], "distortion": LENS}
    with pytest.raises(Exception, match=word if word != "shape" else "shape|distortion"):
        Camera(**{**good, **change})
