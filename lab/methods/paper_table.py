"""What the paper measured of each method (DeVRF, Table 1): means over its inward-facing scenes, on an RTX 3090."""

from typing import NamedTuple

from devrf.lab.methods.method_table import Regime


class PaperRow(NamedTuple):
    """Means over scenes; LPIPS by VGG, hours of training."""

    psnr: float
    ssim: float
    lpips: float
    hours: float


TABLE_1 = "DeVRF, Table 1: mean of its five synthetic scenes (other data; 400x400, RTX 3090)"
SYNTHETIC: dict[tuple[str, Regime], PaperRow] = {
    ("neural-volumes", "dynamic"): PaperRow(9.620, 0.532, 0.5520, 22.4),
    ("d-nerf", "joint"): PaperRow(31.83, 0.960, 0.0355, 18.4),
    ("d-nerf", "two-stage"): PaperRow(28.29, 0.945, 0.0528, 18.4),
    ("d-nerf", "dynamic"): PaperRow(17.59, 0.839, 0.2058, 21.9),
    ("nerfies", "joint"): PaperRow(33.09, 0.989, 0.0432, 18.7),
    ("nerfies", "two-stage"): PaperRow(32.37, 0.991, 0.0322, 15.8),
    ("nerfies", "dynamic"): PaperRow(19.45, 0.794, 0.1674, 21.3),
    ("hyper-nerf", "joint"): PaperRow(33.73, 0.965, 0.0335, 20.5),
    ("hyper-nerf", "two-stage"): PaperRow(29.16, 0.953, 0.0555, 19.2),
    ("hyper-nerf", "dynamic"): PaperRow(18.00, 0.786, 0.2173, 20.6),
    ("nsff", "joint"): PaperRow(27.06, 0.936, 0.0800, 12.8),
    ("nsff", "dynamic"): PaperRow(18.18, 0.858, 0.1929, 15.5),
    ("devrf-reference", "joint"): PaperRow(34.29, 0.982, 0.0137, 8 / 60),
}
