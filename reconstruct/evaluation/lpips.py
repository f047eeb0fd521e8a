"""LPIPS, the learned perceptual distance (Zhang et al., CVPR 2018), version 0.1, on VGG16 or AlexNet.

Needs weights that are not part of this package (`lpips_weights.py`); without them there is no value.
"""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.evaluation.lpips_weights import Net, Source, load_weights

if TYPE_CHECKING:
    import torch

SMALLEST_SIDE = 64  # pixels; the size of the examples it is checked on; AlexNet's last maps are then 3 x 3
MEAN = (-0.030, -0.088, -0.188)  # of ImageNet pictures scaled to [-1, 1], as LPIPS has them
STD = (0.458, 0.448, 0.450)
# One entry per block whose last activation is compared: convolutions as (layer number, stride, padding)
BLOCKS: dict[Net, tuple[tuple[tuple[int, int, int], ...], ...]] = {
    "alex": (((0, 4, 2),), ((3, 1, 2),), ((6, 1, 1),), ((8, 1, 1),), ((10, 1, 1),)),
    "vgg": tuple(
        tuple((n, 1, 1) for n in block)
        for block in ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28))
    ),
}
POOL: dict[Net, tuple[int, int]] = {"alex": (3, 2), "vgg": (2, 2)}  # window, stride
POOL_BEFORE: dict[Net, tuple[int, ...]] = {"alex": (1, 2), "vgg": (1, 2, 3, 4)}  # blocks


class Lpips:
    """The distance between pictures in the features of one network."""

    def __init__(self, net: Net, source: Source, device: str = "cpu") -> None:
        """Find the weights in a folder, or download them, and compute on `device`.

        Raises:
            ReconstructError: No such weights.
        """
        trunk, heads = load_weights(net, source)
        self.net: Net = net
        self._device = device
        self._convolutions = {name: value.to(device) for name, value in trunk.items()}
        self._heads = [head.to(device) for head in heads]

    def features(self, picture: Float[np.ndarray, "height width 3"]) -> "list[torch.Tensor]":
        """Unit-length features of the five compared layers; keep them where a picture is compared twice.

        Raises:
            ReconstructError: A picture too small for the network.
        """
        import torch
        from torch.nn import functional as F

        if min(picture.shape[:2]) < SMALLEST_SIDE:
            text = (
                f"picture is {picture.shape[1]}x{picture.shape[0]}, LPIPS needs {SMALLEST_SIDE} pixels a side"
            )
            raise ReconstructError("picture-too-small", text)
        x = (2 * picture.astype(np.float32) - 1 - np.array(MEAN, np.float32)) / np.array(STD, np.float32)
        x = torch.from_numpy(np.ascontiguousarray(x.transpose(2, 0, 1)))[None].to(self._device)
        out = []
        with torch.inference_mode():
            for number, block in enumerate(BLOCKS[self.net]):
                if number in POOL_BEFORE[self.net]:
                    x = F.max_pool2d(x, *POOL[self.net])
                for n, stride, padding in block:
                    weight, bias = (self._convolutions[f"features.{n}.{p}"] for p in ("weight", "bias"))
                    x = F.relu(F.conv2d(x, weight, bias, stride=stride, padding=padding))
                out.append(x / (x.norm(dim=1, keepdim=True) + 1e-10))
        return out

    def distance(self, a: "list[torch.Tensor]", b: "list[torch.Tensor]") -> float:
        """LPIPS between two pictures given by their features; 0 for equal pictures."""
        return float(
            sum((head * (x - y) ** 2).sum(dim=1).mean() for head, x, y in zip(self._heads, a, b, strict=True))
        )

    def __call__(
        self, a: Float[np.ndarray, "height width 3"], b: Float[np.ndarray, "height width 3"]
    ) -> float:
        """LPIPS between two RGB pictures in [0, 1]."""
        return self.distance(self.features(a), self.features(b))
