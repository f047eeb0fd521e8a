"""Damage done on purpose does what it says, and nothing else."""

from pathlib import Path

import numpy as np
import pytest

from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.camera import Camera
from devrf.capture.colour.srgb import linear_from_srgb
from devrf.capture.scene import Scene
from devrf.capture.video.audio import read_sound
from devrf.capture.video.reader import VideoReader
from devrf.lab.simulate.render.sensor import ClipWriter
from devrf.lab.simulate.session.damage import (
    Picture,
    blurred,
    pierced,
    relit,
    turned,
    with_smaller_box,
    write_again,
    zoomed,
)


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
    write_again(
        tmp_path / "old.mp4",
        tmp_path / "new.mp4",
        lambda number, count: number % 2 == 0,
        lambda picture, when: picture // 2,
    )
    with VideoReader(tmp_path / "new.mp4") as reader:
        found = [(frame.time_s, float(frame.rgb.mean())) for frame in reader]
    assert [time for time, _ in found] == pytest.approx(times[::2], abs=1e-3)
    assert [level for _, level in found] == pytest.approx([0, 40, 80], abs=3)


def test_a_clip_written_again_keeps_its_sound_and_says_where_in_the_clip_a_picture_is(tmp_path: Path) -> None:
    clip = ClipWriter(tmp_path / "old.mp4", (32, 16), 10.0, 17, 48_000)
    loud = np.zeros(24_000, np.int64)
    loud[9_600:9_700] = 20_000  # at 0.2 s
    clip.sound(loud)
    for n in range(5):
        clip.picture(np.full((16, 32, 3), 100, np.uint8), n / 10)
    clip.close()
    asked: list[float] = []

    def change(picture: Picture, when: float) -> Picture:
        asked.append(when)
        return picture

    write_again(tmp_path / "old.mp4", tmp_path / "new.mp4", lambda number, count: number + 1 < count, change)
    assert asked == [0.0, 0.25, 0.5, 0.75]
    sounds = [read_sound(tmp_path / name) for name in ("old.mp4", "new.mp4")]
    peaks_s = [s.start_s + np.abs(s.samples).argmax() / s.rate_hz for s in sounds if s is not None]
    assert len(peaks_s) == 2 and peaks_s[0] == pytest.approx(peaks_s[1], abs=0.001)


def test_a_stop_is_twice_the_light() -> None:
    picture = np.full((4, 4, 3), 100, np.uint8)
    light = linear_from_srgb(relit(picture, np.array([1.0, 0.0, -1.0])) / 255.0)
    was = linear_from_srgb(np.array([100 / 255.0]))
    np.testing.assert_allclose(light[0, 0] / was, [2.0, 1.0, 0.5], rtol=0.02)


def test_holes_cover_the_share_of_the_subject_that_was_asked_for() -> None:
    alpha = np.zeros((60, 80), np.uint8)
    alpha[10:50, 20:60] = 255
    holed = pierced(alpha, 0.3, np.random.default_rng(0))
    lost = 1 - (holed > 0).sum() / (alpha > 0).sum()
    assert 0.3 <= lost < 0.32 and not holed[alpha == 0].any()
    np.testing.assert_array_equal(pierced(0 * alpha, 0.3, np.random.default_rng(0)), 0)
