"""Which pixels of a test picture move, by the words of `test_moving`."""

import cv2
import numpy as np

from devrf.reconstruct.sampling.clean_plate import StillPicture


def test_pixels_that_differ_after_a_blur_move_and_two_pixels_around() -> None:
    rng = np.random.default_rng(0)
    stands = rng.random((60, 80, 3)).astype(np.float32)
    picture = stands.copy()
    picture[20:40, 30:50, 1] += 0.2  # one channel is enough
    picture[50, 70] += 0.3  # noise of one pixel: blurred, it is 0.3 / (2 pi 1.2^2) = 0.033
    picture[5:15, 5:15] += 0.04  # too little
    blurred = cv2.GaussianBlur(picture - stands, (0, 0), 1.2, borderType=cv2.BORDER_REFLECT)
    expected = cv2.dilate((np.abs(blurred).max(-1) > 0.05).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    found = StillPicture(stands, np.ones((60, 80), bool), "rest").moving(picture)
    np.testing.assert_array_equal(found, expected)
    assert found[20:40, 30:50].all() and not found[45:, 60:].any() and not found[:16, :16].any()
    assert not StillPicture(stands, np.ones((60, 80), bool), "rest").moving(stands).any()
