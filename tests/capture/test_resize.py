"""Shrinking keeps the mean over areas; OpenCV, where it is installed, agrees."""

import numpy as np
import pytest

from devrf.capture.photos.resize import area_weights, filter_sides, shrink, window_weights

SIZES = [(40, 30), (20, 15), (10, 10), (33, 29), (27, 30), (40, 7), (1, 1)]  # of a picture of 40 x 30


@pytest.mark.parametrize("size", SIZES)
def test_areas_are_shared_out(size):
    for old, new in zip((40, 30), size, strict=True):
        weights = area_weights(old, new).toarray()
        np.testing.assert_allclose(weights.sum(1), 1, atol=1e-6)
        np.testing.assert_allclose(weights.sum(0), new / old, atol=1e-6)  # every old pixel counts alike


def test_a_pixel_that_lies_across_two():
    np.testing.assert_allclose(
        area_weights(3, 2).toarray(), [[2 / 3, 1 / 3, 0], [0, 1 / 3, 2 / 3]], atol=1e-6
    )


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("channels", [(), (3,), (4,)])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_shrinking_is_opencvs(size, channels, dtype):
    cv2 = pytest.importorskip("cv2")
    picture = np.random.default_rng(0).integers(0, 256, (30, 40, *channels)).astype(dtype)
    small = shrink(picture, *size)
    assert small.dtype == dtype and small.shape == (size[1], size[0], *channels)
    theirs = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    # ties may be rounded either way; single precision sums of 255 err by 1e-4
    np.testing.assert_allclose(
        small.astype(float), theirs.astype(float), atol=1 if dtype == np.uint8 else 1e-3
    )


def test_enlarging_is_refused():
    with pytest.raises(ValueError, match="cannot shrink 4x3 to 5x3"):
        shrink(np.zeros((3, 4), np.uint8), 5, 3)


def test_windows_lie_inside():
    taps = np.array([0.25, 0.5, 0.25])
    picture = np.random.default_rng(0).random((6, 8, 3))
    out = filter_sides(picture, window_weights(taps, 6), window_weights(taps, 8))
    assert out.shape == (4, 6, 3)
    np.testing.assert_allclose(out[1, 2], np.einsum("i,j,ijc->c", taps, taps, picture[1:4, 2:5]), atol=1e-12)
