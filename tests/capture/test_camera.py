"""The camera against closed forms, OpenCV's own projection, and invariances."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from devrf.capture.camera import Camera, distort, distort_many, undistort

K = np.array([[500.0, 0, 310.5], [0, 480.0, 243.0], [0, 0, 1]])
LENS = np.array([-0.3, 0.12, 0.002, -0.001, -0.02])


def test_focal_lengths_are_positive():
    with pytest.raises(ValueError, match="focal lengths -5, 1, expected more than 0"):
        Camera(4, 4, np.diag([-5.0, 1.0, 1.0]), np.eye(3, 4))


def pose(rotvec, centre) -> np.ndarray:
    R = cv2.Rodrigues(np.asarray(rotvec, dtype=np.float64))[0]
    return np.column_stack([R, -R @ np.asarray(centre, dtype=np.float64)])


def camera(distortion=LENS) -> Camera:
    return Camera(640, 480, K, pose([0.2, -0.4, 0.1], [0.3, -1.0, -3.0]), distortion)


def points(n=50) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.6, 0.6, (n, 3))


def test_a_point_on_the_axis_lands_on_the_principal_point():
    cam = camera()
    np.testing.assert_allclose(
        cam.project(cam.centre + 2 * cam.cam_from_world[2, :3]), [310.5, 243.0], atol=1e-9
    )


def test_projection_agrees_with_opencv_up_to_its_half_pixel():
    cam = camera()
    k_cv = K.copy()
    k_cv[:2, 2] -= 0.5
    rvec = cv2.Rodrigues(cam.cam_from_world[:, :3])[0]
    theirs = cv2.projectPoints(points(), rvec, cam.cam_from_world[:, 3], k_cv, LENS)[0].reshape(-1, 2)
    np.testing.assert_allclose(cam.project(points()), theirs + 0.5, atol=1e-9)


def test_points_behind_the_camera_are_nan():
    cam = camera()
    assert np.isnan(cam.project(cam.centre - cam.cam_from_world[2, :3])).all()


def test_directions_invert_projection():
    cam = camera()
    truth = points() - cam.centre
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    np.testing.assert_allclose(cam.directions(cam.project(points())), truth, atol=1e-9)


@pytest.mark.parametrize("lens", [LENS, np.zeros(5), np.array([0.2, 0, 0, 0, 0.0])])
def test_undistort_inverts_distort(lens):
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (4, 25, 2))
    np.testing.assert_allclose(undistort(distort(x, lens), lens), x, atol=1e-9)


FISHEYE = np.array([0.05, -0.01, 0.003, -0.0005, 0.0])


def fisheye_camera() -> Camera:
    return replace(camera(FISHEYE), model="OPENCV_FISHEYE")


def wide_points(n=200) -> np.ndarray:
    """World points up to 80 degrees from the axis of the camera."""
    rng = np.random.default_rng(4)
    theta, phi = np.radians(rng.uniform(0, 80, n)), rng.uniform(0, 2 * np.pi, n)
    rays = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=1)
    cam = camera()
    return cam.centre + 2 * rays @ cam.cam_from_world[:, :3]


def test_a_fisheye_projects_as_opencv_up_to_its_half_pixel():
    cam = fisheye_camera()
    k_cv = K.copy()
    k_cv[:2, 2] -= 0.5
    rvec, tvec = cv2.Rodrigues(cam.cam_from_world[:, :3])[0], cam.cam_from_world[:, 3]
    theirs = cv2.fisheye.projectPoints(wide_points()[:, None], rvec, tvec, k_cv, FISHEYE[:4])[0].reshape(
        -1, 2
    )
    np.testing.assert_allclose(cam.project(wide_points()), theirs + 0.5, atol=1e-8)


def test_directions_of_a_fisheye_invert_projection_and_go_on_beyond_90_degrees():
    cam = fisheye_camera()
    truth = wide_points() - cam.centre
    truth /= np.linalg.norm(truth, axis=-1, keepdims=True)
    np.testing.assert_allclose(cam.directions(cam.project(wide_points())), truth, atol=1e-9)
    # without distortion a picture radius of f x 100 degrees is 100 degrees from the axis
    ideal = Camera(640, 480, np.diag([200.0, 200.0, 1.0]), np.eye(3, 4), np.zeros(5), "OPENCV_FISHEYE")
    angle = np.radians(100)
    seen = ideal.directions(np.array([[200 * angle, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(seen, [[np.sin(angle), 0, np.cos(angle)], [0, 0, 1]], atol=1e-12)


def test_many_lenses_at_once_distort_as_one_by_one():
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (6, 2))
    fisheye = np.arange(6) % 2 == 0
    lenses = np.where(fisheye[:, None], FISHEYE, LENS)
    expected = [distort(x[n], lenses[n], "OPENCV_FISHEYE" if fisheye[n] else "OPENCV") for n in range(len(x))]
    np.testing.assert_allclose(distort_many(x, lenses, fisheye), expected, atol=1e-15)


def test_undistort_inverts_distort_of_a_fisheye():
    x = np.random.default_rng(1).uniform(-3, 3, (4, 25, 2))
    there = distort(x, FISHEYE, "OPENCV_FISHEYE")
    np.testing.assert_allclose(undistort(there, FISHEYE, "OPENCV_FISHEYE"), x, atol=1e-8)
    np.testing.assert_array_equal(undistort(np.zeros((1, 2)), FISHEYE, "OPENCV_FISHEYE"), [[0, 0]])


@pytest.mark.parametrize("scale", [0.5, 0.37, 2.0])
def test_scaled_camera_sees_scaled_pixels(scale):
    cam = camera()
    small = cam.scaled(scale)
    ratio = np.array([small.width / cam.width, small.height / cam.height])
    np.testing.assert_allclose(small.project(points()), cam.project(points()) * ratio, atol=1e-9)


def test_moving_the_world_and_the_camera_together_changes_no_pixel():
    similarity = np.eye(4)
    similarity[:3, :3] = 2.5 * cv2.Rodrigues(np.array([0.5, 1.0, -0.3]))[0]
    similarity[:3, 3] = [1, -2, 3]
    moved = points() @ similarity[:3, :3].T + similarity[:3, 3]
    np.testing.assert_allclose(
        camera().moved(similarity).project(moved), camera().project(points()), atol=1e-8
    )


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
