"""How close a rendered picture is to the true one: PSNR and SSIM.

Pictures are float RGB [height, width, 3] in [0, 1]. The rendered one is taken as it is, neither rounded to
8 bits nor clipped; no gain or offset is ever fitted.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from devrf.capture.photos.resize import filter_sides, window_weights

SMALLEST_MSE = 1e-10  # equal pictures count as 100 dB, so that means stay finite
SSIM_TAPS = 11
SSIM_SIGMA = 1.5
SSIM_K1, SSIM_K2 = 0.01, 0.03

Picture = Float[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class Scores:
    """PSNR (dB) and SSIM of one picture or of a part of it; None where it cannot be computed."""

    psnr: float | None
    ssim: float | None


class Comparison:
    """A rendered picture beside the true one; scores over the whole and over parts."""

    def __init__(self, rendered: Picture, true: Picture) -> None:
        self._rendered, self._true = rendered, true
        self._ssim = ssim_map(rendered, true)

    def whole(self) -> Scores:
        """PSNR and SSIM over the picture."""
        return Scores(psnr(self._rendered, self._true), float(self._ssim.mean()) if self._ssim.size else None)

    def part(self, where: Bool[np.ndarray, "height width"]) -> Scores:
        """PSNR and SSIM over the pixels `where`; None where no pixel is left.

        SSIM is the mean of its map over those pixels whose whole window lies in the picture.
        """
        if not where.any():
            return Scores(None, None)
        r = SSIM_TAPS // 2
        inner = where[r:-r, r:-r] if self._ssim.size else np.zeros((0, 0), dtype=bool)
        return Scores(
            psnr(self._rendered[where], self._true[where]),
            float(self._ssim[inner].mean()) if inner.any() else None,
        )


def psnr(rendered: Float[np.ndarray, "*batch 3"], true: Float[np.ndarray, "*batch 3"]) -> float:
    """-10 log10 of the mean squared error over pixels and channels, dB; at most 100."""
    mse = float(np.mean((rendered.astype(np.float64) - true) ** 2))
    return float(-10 * np.log10(max(mse, SMALLEST_MSE)))


def ssim_map(rendered: Picture, true: Picture) -> Float64[np.ndarray, "inner_height inner_width 3"]:
    """Structural similarity (Wang et al., 2004) of each 11 x 11 Gaussian window that lies in the picture.

    As mip-NeRF computes it: sigma 1.5, range 1, each channel on its own, variances not below zero and the
    covariance within what they allow. Empty for pictures smaller than the window.
    """
    r = SSIM_TAPS // 2
    if min(true.shape[:2]) < SSIM_TAPS:
        return np.zeros((0, 0, 3))
    taps = np.exp(-0.5 * ((np.arange(SSIM_TAPS) - r) / SSIM_SIGMA) ** 2)
    taps /= taps.sum()
    rows, columns = (window_weights(taps, side) for side in true.shape[:2])

    def blur(x: np.ndarray) -> np.ndarray:
        return filter_sides(x, rows, columns)

    a, b = rendered.astype(np.float64), true.astype(np.float64)
    mean_a, mean_b = blur(a), blur(b)
    var_a = np.maximum(0, blur(a * a) - mean_a**2)
    var_b = np.maximum(0, blur(b * b) - mean_b**2)
    covariance = blur(a * b) - mean_a * mean_b
    covariance = np.sign(covariance) * np.minimum(np.sqrt(var_a * var_b), np.abs(covariance))
    c1, c2 = SSIM_K1**2, SSIM_K2**2
    return ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
