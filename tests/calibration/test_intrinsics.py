"""A lens belongs to the stored picture: what it becomes where pictures are turned, or have pixels not square."""

from dataclasses import replace

import numpy as np
import pytest

from devrf.calibration.boards.calibrate import PINHOLE, calibrate_intrinsics
from devrf.calibration.intrinsics import from_vector, guess
from devrf.capture.orientation import by_exif
from devrf.lab.bench.accuracy.simulated_boards import SIZE, SPEC, board_views

BROWN = np.array([500.0, 530, 310, 250, -0.1, 0.05, 0.004, -0.007, 0.01])
FISHEYE = np.array([300.0, 310, 310, 250, 0.02, -0.01, 0.004, -0.002, 0.0])


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_lens_is_turned_as_its_pictures_are(orientation, model):
    upright = by_exif(orientation)
    lens = from_vector(640, 480, BROWN if model == "OPENCV" else FISHEYE, np.arange(1.0, 10.0), model)
    turned = lens.turned(upright)
    places = np.random.default_rng(0).normal(size=(20, 3)) * [0.4, 0.3, 0.1] + [0, 0, 1]
    L = np.eye(3)
    L[:2, :2] = upright.matrix
    seen = upright.points(lens.at(np.eye(3, 4)).project(places), 640, 480)
    np.testing.assert_allclose(turned.at(np.eye(3, 4)).project(places @ L.T), seen, atol=1e-9)
    back = turned.turned(upright.inverse)
    assert back.std is not None and lens.std is not None and turned.std is not None
    np.testing.assert_allclose(back.vector, lens.vector, atol=1e-12)
    assert (back.width, back.std.tolist()) == (640, lens.std.tolist())
    assert turned.std[0] == (2.0 if upright.quarters % 2 else 1.0)  # fx's doubt is fy's now


def test_a_guess_has_pixels_as_wide_as_the_file_says():
    wide = guess(1440, 1080, None, 4 / 3)
    assert wide.K[1, 1] / wide.K[0, 0] == pytest.approx(4 / 3)
    assert guess(1440, 1080).K[0, 0] == guess(1440, 1080).K[1, 1] == 1.2 * 1440


def test_a_board_filmed_with_pixels_that_are_not_square():
    """HDV: a row has three quarters as many pixels as square ones would need."""
    square, terms = board_views(6, 0.05), PINHOLE[1]
    truth = calibrate_intrinsics("cam0", square, SPEC, SIZE, lens=terms)
    narrow = [replace(view, xy=view.xy * [0.75, 1.0]) for view in square]
    size = (SIZE[0] * 3 // 4, SIZE[1])
    found = calibrate_intrinsics("cam0", narrow, SPEC, size, lens=terms, pixel_aspect=4 / 3)
    K = np.diag([0.75, 1.0, 1.0]) @ truth.intrinsics.K
    np.testing.assert_allclose(found.intrinsics.K, K, rtol=1e-9)
    assert found.terms == truth.terms and (found.intrinsics.width, found.intrinsics.height) == size
    assert found.intrinsics.std is not None and truth.intrinsics.std is not None
    assert found.intrinsics.std[0] == pytest.approx(0.75 * truth.intrinsics.std[0])
