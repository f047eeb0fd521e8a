"""Pictures of a scene: resizing, alpha, sizes that disagree."""

import cv2
import numpy as np
import pytest
from tests.make.pictures import frame_of
from tests.refused import refused

from devrf.capture.scene import image_scale_for, load_image
from devrf.capture.system.errors import CaptureError


def test_colours_come_back_as_rgb(tmp_path):
    image = np.zeros((4, 6, 3), np.uint8)
    image[..., 0] = 200  # red
    cv2.imwrite(str(tmp_path / "a.png"), image[..., ::-1])
    loaded = load_image(frame_of(tmp_path / "a.png", 6, 4), 1.0, "shell")
    assert loaded.shape == (4, 6, 3) and (loaded[..., 0] == 200).all() and (loaded[..., 1:] == 0).all()


@pytest.mark.parametrize(("background", "behind"), [("white", 255), ("black", 0)])
def test_alpha_is_composited_and_hidden_colours_do_not_bleed(tmp_path, background, behind):
    image = np.zeros((4, 4, 4), np.uint8)
    image[:, :2] = [0, 0, 255, 255]  # red, opaque
    image[:, 2:] = [0, 255, 0, 0]  # green, hidden
    cv2.imwrite(str(tmp_path / "a.png"), image)
    loaded = load_image(frame_of(tmp_path / "a.png", 4, 4), 0.25, background)
    expected = np.round((np.array([255, 0, 0]) + behind) / 2)
    np.testing.assert_allclose(loaded[0, 0], expected, atol=1)


def test_a_picture_of_another_size_than_its_calibration_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 6, 3), np.uint8))
    with refused("picture-size-wrong", "6x4", "8x4", kind=CaptureError):
        load_image(frame_of(tmp_path / "a.png", 8, 4), 1.0, "shell")


def test_a_file_that_is_no_picture_is_named(tmp_path):
    (tmp_path / "a.png").write_text("hello")
    with refused("picture-unreadable", "a.png", kind=CaptureError):
        load_image(frame_of(tmp_path / "a.png", 8, 4), 1.0, "shell")


@pytest.mark.parametrize(("size", "scale"), [((400, 400), 0.5), ((100, 100), 1.0)])
def test_image_scale_keeps_the_pixel_budget_and_never_enlarges(size, scale):
    assert image_scale_for(size[0], size[1], 40_000) == pytest.approx(scale)
