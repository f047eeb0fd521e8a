"""LPIPS gives upstream's values on upstream's example pictures."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.refused import refused

from devrf.capture.errors import ReconstructError
from devrf.reconstruct.lpips import Lpips


def _picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"), dtype=np.float32) / 255


# computed in double precision, with the same half-precision convolutions, by an independent program
@pytest.mark.parametrize(("net", "far", "near"), [("alex", 0.72188, 0.13757), ("vgg", 0.56861, 0.42166)])
def test_reference_values(data_dir, net, far, near):
    lpips = Lpips(net, data_dir / "weights")
    ref, p0, p1 = (_picture(data_dir / "weights" / "lpips_ref" / f"ex_{n}.png") for n in ("ref", "p0", "p1"))
    assert lpips(ref, p0) == pytest.approx(far, abs=1e-4)
    assert lpips(ref, p1) == pytest.approx(near, abs=1e-4)
    assert lpips(ref, ref) == 0
    kept = lpips.features(ref)
    assert lpips.distance(kept, lpips.features(p1)) == pytest.approx(lpips(p1, ref), abs=1e-6)


def test_too_small_pictures_are_refused(data_dir):
    small = np.zeros((20, 80, 3), np.float32)
    with refused("picture-too-small", "80x20", kind=ReconstructError):
        Lpips("alex", data_dir / "weights")(small, small)
