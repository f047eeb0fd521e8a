"""What the paper measured of each method (DeVRF, Table 1): means over its inward-facing scenes, on an RTX 3090."""

from typing import NamedTuple

from devrf.lab.methods.method_table import Regime


class Published(NamedTuple):
    """Means over scenes; LPIPS by VGG, hours of training."""

    psnr: float
    ssim: float
    lpips: float
    hours: float


TABLE_1 = "DeVRF, Table 1: mean of its five synthetic scenes (other data; 400x400, RTX 3090)"
SYNTHETIC: dict[tuple[str, Regime], Published] = {
    ("neural-volumes", "dynamic"): Published(9.620, 0.532, 0.5520, 22.4),
    ("d-nerf", "joint"): Published(31.83, 0.960, 0.0355, 18.4),
    ("d-nerf", "two-stage"): Published(28.29, 0.945, 0.0528, 18.4),
    ("d-nerf", "dynamic"): Published(17.59, 0.839, 0.2058, 21.9),
    ("nerfies", "joint"): Published(33.09, 0.989, 0.0432, 18.7),
    ("nerfies", "two-stage"): Published(32.37, 0.991, 0.0322, 15.8),
    ("nerfies", "dynamic"): Published(19.45, 0.794, 0.1674, 21.3),
    ("hyper-nerf", "joint"): Published(33.73, 0.965, 0.0335, 20.5),
    ("hyper-nerf", "two-stage"): Published(29.16, 0.953, 0.0555, 19.2),
    ("hyper-nerf", "dynamic"): Published(18.00, 0.786, 0.2173, 20.6),
    ("nsff", "joint"): Published(27.06, 0.936, 0.0800, 12.8),
    ("nsff", "dynamic"): Published(18.18, 0.858, 0.1929, 15.5),
    ("devrf-reference", "joint"): Published(34.29, 0.982, 0.0137, 8 / 60),
}
