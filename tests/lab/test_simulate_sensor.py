"""The simulated camera, against closed forms and against itself by another way."""

from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.render.mitsuba import linear_to_srgb, srgb_to_linear
from devrf.lab.simulate.render.renderer import Renderer
from devrf.lab.simulate.render.sensor import (
    BoardCamera,
    ClipWriter,
    board_corners,
    board_picture,
    board_poses,
    charuco_board,
    expose,
)
from devrf.lab.simulate.scenes.catalogue import picture_on_quad
from devrf.lab.simulate.session.camera_rig import board_pose

SQUARES, SQUARE_M = (8, 6), 0.06


def _camera(width: int = 320, height: int = 240, k1: float = -0.12) -> Camera:
    K = np.array([[0.9 * width, 0, 0.51 * width], [0, 0.9 * width, 0.485 * height], [0, 0, 1.0]])
    return Camera(width, height, K, np.eye(3, 4), np.array([k1, 0, 0, 0, 0]))


def _detect(picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners [N, 2], the centre of the first pixel at (0.5, 0.5), and their numbers [N]."""
    detector = cv2.aruco.CharucoDetector(charuco_board(SQUARES, SQUARE_M))
    corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))
    if ids is None:
        return np.zeros((0, 2)), np.zeros(0, int)
    return np.asarray(corners).reshape(-1, 2) + 0.5, np.asarray(ids).ravel()


def _true_corners(camera: Camera, world_from_board: np.ndarray, ids: np.ndarray) -> np.ndarray:
    points = np.array(charuco_board(SQUARES, SQUARE_M).getChessboardCorners(), dtype=np.float64)[ids]
    return camera.project(points @ world_from_board[:3, :3].T + world_from_board[:3, 3])


@pytest.mark.full
def test_board_pictures_show_corners_where_the_camera_projects_them() -> None:
    camera = _camera(480, 360)
    show = BoardCamera(camera, np.full((360, 480, 3), 0.3, np.float32), SQUARES, SQUARE_M)
    seen = np.zeros((2, 2))
    found = 0
    poses = board_poses(np.random.default_rng(0), camera, SQUARES, SQUARE_M, 9)
    for pose in (poses[0], poses[2], poses[6], poses[8]):
        corners, ids = _detect(expose(show(pose), 1.0, 0.0, np.random.default_rng(0)))
        error = corners - _true_corners(camera, np.vstack([pose, [0, 0, 0, 1]]), ids)
        found += len(ids)
        if len(ids) > 8:
            assert np.abs(error.mean(0)).max() < 0.08  # a half-pixel slip would be 0.5
            assert np.median(np.linalg.norm(error, axis=1)) < 0.2  # one corner at the rim may be misread
        for corner in corners:
            seen[int(corner[1] > 180), int(corner[0] > 240)] += 1
    assert found > 70 and seen.min() > 5  # over the whole picture


def test_rendered_board_agrees_with_exact_board_through_a_distorting_lens() -> None:
    pytest.importorskip("mitsuba")
    world_from_board = board_pose()
    middle = board_corners(SQUARES, SQUARE_M, world_from_board).mean(0)
    camera = _camera(k1=-0.2)
    pose = look_at(middle + [-0.5, 0.25, 0.15], middle, roll_deg=7.0)
    camera = Camera(camera.width, camera.height, camera.K, pose, camera.distortion)
    quad = picture_on_quad(board_corners(SQUARES, SQUARE_M, world_from_board), board_picture(SQUARES))
    radiance = Renderer([quad], spp=16)(camera, [], seed=0)
    show = BoardCamera(camera, np.zeros_like(radiance), SQUARES, SQUARE_M)
    exact = show((np.vstack([pose, [0, 0, 0, 1]]) @ world_from_board)[:3])
    a, b = radiance[..., 1] / np.percentile(radiance, 95), exact[..., 1] / np.percentile(exact, 95)
    (dx, dy), _ = cv2.phaseCorrelate(a.astype(np.float64), b.astype(np.float64))
    assert abs(dx) < 0.02 and abs(dy) < 0.02
    assert np.abs(a - b).mean() < 0.03
    corners, ids = _detect(expose(radiance, 1.0, 0.0, np.random.default_rng(0)))
    error = corners - _true_corners(camera, world_from_board, ids)
    assert len(ids) > 25 and np.sqrt((error**2).sum(1).mean()) < 0.2


def test_even_light_on_a_grey_wall_has_little_noise() -> None:
    pytest.importorskip("mitsuba")
    wall = np.array([[-2.0, 1, 3], [2, 1, 3], [2, 1, -1], [-2, 1, -1]])
    grey = np.full((8, 8, 3), 128, np.uint8)
    camera = Camera(64, 48, _camera(64, 48).K, look_at(np.array([0.0, -0.5, 1]), np.array([0.0, 1, 1])))
    radiance = Renderer([picture_on_quad(wall, grey)], spp=16)(camera, [], seed=0)
    assert radiance.min() > 0.7 * srgb_to_linear(grey)[0, 0, 0]  # seen from its front, everywhere
    rows = radiance[..., 0] / radiance[..., 0].mean(axis=1, keepdims=True)
    assert rows[:, 16:48].std() < 0.03


def test_moments_of_an_exposure_are_as_bright_as_one_and_share_its_light_paths() -> None:
    pytest.importorskip("mitsuba")
    wall = np.array([[-2.0, 1, 3], [2, 1, 3], [2, 1, -1], [-2, 1, -1]])
    camera = Camera(64, 48, _camera(64, 48).K, look_at(np.array([0.0, -0.5, 1]), np.array([0.0, 1, 1])))
    renderer = Renderer([picture_on_quad(wall, np.full((8, 8, 3), 128, np.uint8))], spp=24)
    whole, again = (renderer(camera, [], seed=n) for n in (0, 1))
    moments = [renderer(camera, [], seed=n, moments=6) for n in range(6)]
    np.testing.assert_allclose(np.mean(moments, (0, 1, 2)), whole.mean((0, 1)), rtol=0.01)
    assert (moments[0] - moments[1]).std() > 1.5 * (whole - again).std()  # each has a part of the paths


def test_exposure_is_linear_and_noise_has_the_asked_size() -> None:
    rng = np.random.default_rng(0)
    grey = np.full((200, 200, 3), 0.18, np.float32)
    noisy = expose(grey, 1.0, 0.02, rng) / 255
    assert noisy.std() == pytest.approx(0.02, rel=0.05)
    assert noisy.mean() == pytest.approx(0.4614, abs=0.002)  # sRGB of 18 % grey
    twice = srgb_to_linear(expose(grey, 2.0, 0.0, rng)).mean()
    assert twice == pytest.approx(0.36, rel=0.01)
    assert expose(np.full((2, 2, 3), 9.0, np.float32), 1.0, 0.02, rng).min() == 255


def test_srgb_both_ways() -> None:
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal((255 * linear_to_srgb(srgb_to_linear(levels))).round(), levels)


def test_clip_keeps_colours_and_times(tmp_path: Path) -> None:
    colours = [(200, 60, 40), (40, 180, 70), (50, 70, 190), (128, 128, 128), (235, 235, 235)]
    times_s = [0.0, 0.0625, 0.1, 0.2034, 0.25]
    clip = ClipWriter(tmp_path / "a.mp4", (64, 48), 16.0, 10, sample_rate=48_000)
    clip.sound(np.zeros(14_400, np.int16))
    for colour, time_s in zip(colours, times_s, strict=True):
        clip.picture(np.full((48, 64, 3), colour, np.uint8), time_s)
    clip.close()
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        assert container.streams.audio[0].codec_context.name == "aac"
        frames = list(container.decode(video=0))
    np.testing.assert_allclose([f.time for f in frames], times_s, atol=1e-5)
    for frame, colour in zip(frames, colours, strict=True):
        np.testing.assert_allclose(frame.to_ndarray(format="rgb24").mean((0, 1)), colour, atol=3)
