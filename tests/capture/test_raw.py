"""RAW: one recipe, nothing adapted to the single picture."""

import numpy as np
import pytest

from devrf.capture.errors import InputError
from devrf.capture.raw import develop, is_raw
from devrf.capture.srgb import linear_from_srgb, srgb_from_linear


def test_srgb_curve():
    x = np.linspace(0, 1, 257)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(x)), x, atol=1e-12)
    assert srgb_from_linear(np.array([0.0, 1.0])) == pytest.approx([0.0, 1.0])
    assert srgb_from_linear(np.array(0.2140411)) == pytest.approx(0.5, abs=1e-6)  # IEC 61966-2-1


def test_real_raw_file(data_dir):
    path = data_dir / "raw" / "RAW_KODAK_DC50.KDC"
    assert is_raw(path) and not is_raw(path.with_suffix(".jpg"))
    one = develop(path)
    assert one.rgb.shape == (512, 768, 3) and 60 < one.rgb.mean() < 160 and one.clipped < 0.01
    np.testing.assert_array_equal(one.rgb, develop(path, one.white_balance).rgb)
    red = develop(path, (0.5, 1.0, 1.0, 1.0)).rgb
    darker = linear_from_srgb(red[..., 0] / 255.0).mean() / linear_from_srgb(one.rgb[..., 0] / 255.0).mean()
    assert darker < 0.8  # the balance that is given is the balance that is used


def test_not_raw(tmp_path):
    path = tmp_path / "a.dng"
    path.write_text("hello")
    with pytest.raises(InputError, match="a.dng: not a RAW file"):
        develop(path)
    with pytest.raises(InputError, match="no such file"):
        develop(tmp_path / "b.dng")
