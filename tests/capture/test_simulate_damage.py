"""Damage done on purpose does what it says, and nothing else."""

from pathlib import Path

import numpy as np
import pytest

from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.simulate.damage import blurred, turned, with_smaller_box, write_again, zoomed
from devrf.capture.simulate.sensor import ClipWriter
from devrf.capture.srgb import linear_from_srgb
from devrf.capture.video import VideoReader


@pytest.fixture
def camera() -> Camera:
    pose = np.column_stack([np.eye(3), [0.1, -0.2, 3.0]])
    return Camera(64, 48, np.array([[60.0, 0, 32], [0, 61, 24], [0, 0, 1]]), pose)


@pytest.mark.parametrize("share", [1 / 64, 2.5 / 64, 5 / 64])
def test_blur_spreads_the_light_of_a_line_and_keeps_it(share: float) -> None:
    picture = np.zeros((8, 64, 3), np.uint8)
    picture[:, 32] = 255
    light = linear_from_srgb(blurred(picture, share) / 255.0)[4, :, 0]
    assert light.sum() == pytest.approx(1, abs=0.02)  # levels of 1/255, five of them
    spread = np.sqrt((light * (np.arange(64) - 32.0) ** 2).sum() / light.sum())
    across = 64 * share
    assert spread == pytest.approx(0 if across == 1 else _std_of_boxes(across), abs=0.03)


def _std_of_boxes(across: float) -> float:
    """Of whole pixels, the outermost counting in part: the variance of their places."""
    half = int(np.ceil((across - 1) / 2))
    weights = np.ones(2 * half + 1)
    weights[[0, -1]] = (across - (2 * half - 1)) / 2
    return float(np.sqrt((weights * np.arange(-half, half + 1) ** 2).sum() / weights.sum()))


def test_no_blur_changes_nothing() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (8, 16, 3)).astype(np.uint8)
    np.testing.assert_array_equal(blurred(picture, 0.0), picture)


def test_a_turned_camera_stays_where_it_is(camera: Camera) -> None:
    wrong = turned(camera, 5.0, np.random.default_rng(1))
    np.testing.assert_allclose(wrong.centre, camera.centre, atol=1e-12)
    angle = rotation_angle_deg(wrong.cam_from_world[:, :3], camera.cam_from_world[:, :3])
    assert angle == pytest.approx(5.0)


def test_a_zoomed_camera_keeps_its_principal_point(camera: Camera) -> None:
    wrong = zoomed(camera, 1.1)
    np.testing.assert_allclose(wrong.K, [[66, 0, 32], [0, 67.1, 24], [0, 0, 1]])
    np.testing.assert_array_equal(camera.K[0], [60, 0, 32])


def test_a_smaller_box_shows_the_same_world_larger(odd_scene: Scene) -> None:
    small = with_smaller_box(odd_scene, 0.5)
    point = np.append(np.linalg.inv(odd_scene.box_from_world)[:3, :3] @ [0.5, 0, 0], 0)
    np.testing.assert_allclose((small.box_from_world @ point)[:3], [1.0, 0, 0], atol=1e-12)  # now on its side
    middle = np.linalg.inv(odd_scene.box_from_world)[:3, 3]
    np.testing.assert_allclose(np.linalg.inv(small.box_from_world)[:3, 3], middle, atol=1e-12)
    assert (small.near, small.far) == (2 * odd_scene.near, 2 * odd_scene.far)


def test_a_clip_written_again_keeps_the_times_of_what_is_left(tmp_path: Path) -> None:
    clip = ClipWriter(tmp_path / "old.mp4", (32, 16), 10.0, 17)
    times = [0.0, 0.1, 0.21, 0.3, 0.4]
    for n, time_s in enumerate(times):
        clip.picture(np.full((16, 32, 3), 40 * n, np.uint8), time_s)
    clip.close()
    write_again(tmp_path / "old.mp4", tmp_path / "new.mp4", 2, lambda picture: picture // 2)
    with VideoReader(tmp_path / "new.mp4") as reader:
        found = [(frame.time_s, float(frame.rgb.mean())) for frame in reader]
    assert [time for time, _ in found] == pytest.approx(times[::2], abs=1e-3)
    assert [level for _, level in found] == pytest.approx([0, 40, 80], abs=3)
