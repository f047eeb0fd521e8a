"""PSNR and SSIM against closed forms and another implementation."""

import numpy as np
import pytest

from devrf.reconstruct.evaluation.metrics import Comparison, psnr, ssim_map


def picture(height: int = 40, width: int = 50, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((height, width, 3)).astype(np.float32)


@pytest.mark.parametrize("offset", [0.1, 0.01, -0.5])
def test_psnr_of_a_constant_error(offset):
    true = picture()
    assert psnr(true + np.float32(offset), true) == pytest.approx(-20 * np.log10(abs(offset)), abs=1e-3)


def test_psnr_is_not_clipped_to_the_valid_range_and_not_rounded():
    white = np.ones((4, 4, 3), np.float32)
    assert psnr(white * np.float32(1.2), white) == pytest.approx(-20 * np.log10(0.2), abs=1e-3)
    assert psnr(white * np.float32(0.9995), white) == pytest.approx(-20 * np.log10(0.0005), abs=1e-2)


def test_equal_pictures():
    assert psnr(picture(), picture()) == 100
    np.testing.assert_allclose(ssim_map(picture(), picture()), 1, atol=1e-9)


@pytest.mark.parametrize(("a", "b"), [(0.2, 0.7), (0.0, 1.0), (0.5, 0.5)])
def test_ssim_of_flat_pictures(a, b):
    flat = np.ones((20, 15, 3), np.float32)
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    out = ssim_map(flat * np.float32(a), flat * np.float32(b))
    assert out.shape == (10, 5, 3)
    np.testing.assert_allclose(out, expected, atol=1e-6)


def test_ssim_is_that_of_scikit_image_on_whole_windows():
    structural_similarity = pytest.importorskip("skimage.metrics").structural_similarity
    true, how = picture(), {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    for other in (picture(seed=1), (true + 0.2 * picture(seed=2)).astype(np.float32), 1 - true):
        pair = (p.astype(np.float64) for p in (other, true))
        _, expected = structural_similarity(*pair, **how, data_range=1.0, channel_axis=2, full=True)
        np.testing.assert_allclose(ssim_map(other, true), expected[5:-5, 5:-5], atol=1e-12)


def test_picture_smaller_than_the_window_has_no_ssim():
    small = picture(10, 30)
    assert Comparison(small, small).whole().ssim is None
    assert Comparison(small, small).part(np.ones((10, 30), bool)).ssim is None
    assert Comparison(small, small).whole().psnr == 100


def test_score_over_a_part_sees_only_that_part():
    true = picture()
    rendered = true.copy()
    rendered[:, 30:] = 0
    left, right = np.zeros((2, 40, 50), bool)
    left[:, :20], right[:, 40:] = True, True
    assert Comparison(rendered, true).part(left).psnr == 100
    assert Comparison(rendered, true).part(left).ssim == pytest.approx(1)
    assert Comparison(rendered, true).part(right).psnr == pytest.approx(psnr(rendered[right], true[right]))
    whole = Comparison(rendered, true).part(np.ones((40, 50), bool))
    assert whole.psnr == pytest.approx(Comparison(rendered, true).whole().psnr)
    assert whole.ssim == pytest.approx(Comparison(rendered, true).whole().ssim)
    nothing = Comparison(rendered, true).part(np.zeros((40, 50), bool))
    assert nothing.psnr is None and nothing.ssim is None


def test_ssim_is_that_of_opencv():
    """The windowed means by OpenCV, the rest by the formula; windows that lie inside."""
    cv2 = pytest.importorskip("cv2")
    rng, true = np.random.default_rng(3), picture(90, 130)
    spoilt = true.copy()
    spoilt[rng.random((90, 130)) < 0.002] += np.float32(0.1)
    taps = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    taps /= taps.sum()
    for other in (spoilt, picture(90, 130, seed=1), 1 - true):
        a, b = other.astype(np.float64), true.astype(np.float64)
        mean_a, mean_b, aa, bb, ab = (
            cv2.sepFilter2D(x, cv2.CV_64F, taps, taps)[5:-5, 5:-5] for x in (a, b, a * a, b * b, a * b)
        )
        expected = (2 * mean_a * mean_b + 1e-4) * (2 * (ab - mean_a * mean_b) + 9e-4)
        expected /= (mean_a**2 + mean_b**2 + 1e-4) * (aa - mean_a**2 + bb - mean_b**2 + 9e-4)
        np.testing.assert_allclose(ssim_map(other, true), expected, atol=1e-9)
