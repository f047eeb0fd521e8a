"""RAFT as an estimator: pictures of any size, on the CPU or a GPU, with weights from a file.

Deterministic on the CPU. On a GPU encoders and updates run in half precision, the correlation in single.
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, UInt8
from torch import Tensor

from devrf.flow.raft.correlation import VOLUME_BYTES
from devrf.flow.raft.network import STRIDE
from devrf.flow.raft.padding import crop, pad
from devrf.flow.raft.weights import load_raft

STEPS = 20  # corrections; more change little (the authors use 12 to 32)
LEAST_VOLUME_BYTES = VOLUME_BYTES >> 8  # smaller ones save nothing against the features themselves
SMALLEST_SIDE = 128  # pixels; below, the coarsest level of the correlation is a single cell


class RaftFlow:
    """RAFT, small or large as the weights say; see `devrf.flow.estimator.FlowEstimator`.

    Args:
        weights: The authors' checkpoint or torchvision's state dict.
        device: cpu or cuda.
    Raises:
        InputError: Weights that are not RAFT's, all of them and nothing else.
    """

    parallel = False  # one pair keeps all cores busy

    def __init__(self, weights: Path, device: str = "cpu") -> None:
        self.device = device
        self.network = load_raft(weights).to(device)
        self.name = f"raft {self.network.sizes.name}"
        self._volume_bytes = VOLUME_BYTES

    def estimate(
        self,
        image0: UInt8[np.ndarray, "*batch height width 3"],
        image1: UInt8[np.ndarray, "*batch height width 3"],
    ) -> Float32[np.ndarray, "*batch height width 2"]:
        """Flow [..., height, width, 2], pixels, from image0 to image1, pair by pair."""
        flow = np.empty((*image0.shape[:-1], 2), dtype=np.float32)
        for at in np.ndindex(image0.shape[:-3]):
            flow[at] = self._pair(image0[at], image1[at])
        return flow

    def _pair(self, image0: np.ndarray, image1: np.ndarray) -> Float32[np.ndarray, "height width 2"]:
        """Where a GPU has no room for it, tried again with smaller volumes, and so from then on."""
        while True:
            try:
                return self._flow(image0, image1)
            except torch.OutOfMemoryError:
                if self._volume_bytes <= LEAST_VOLUME_BYTES:
                    raise
            self._volume_bytes //= 4
            torch.cuda.empty_cache()

    @torch.inference_mode()
    def _flow(self, image0: np.ndarray, image1: np.ndarray) -> Float32[np.ndarray, "height width 2"]:
        height, width = image0.shape[:2]
        first, second = (self._tensor(image) for image in (image0, image1))
        with torch.autocast("cuda", dtype=torch.float16, enabled=self.device == "cuda"):
            flow = self.network(first, second, STEPS, self._volume_bytes)
        return crop(flow.permute(1, 2, 0).cpu().numpy(), height, width)

    def _tensor(self, image: np.ndarray) -> Tensor:
        """RGB from -1 to 1 [3, H, W]."""
        padded = torch.from_numpy(pad(image, SMALLEST_SIDE, STRIDE)).to(self.device)
        return 2 * (padded.permute(2, 0, 1).float() / 255) - 1
