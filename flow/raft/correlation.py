"""How alike every pixel of one feature map is to the surroundings of a place in another (RAFT, Section 3.2).

Level l compares the first map with the second one averaged over 2^l x 2^l cells; averaging commutes with the dot
product, so a level is made without the finer one. A level whose volume of all pairs fits into `VOLUME_BYTES` is
computed once; a larger one never exists: what is asked for is computed from the features at each look. All volumes
together so stay below 4/3 of `VOLUME_BYTES` at any size of picture (one of 1920 x 1080 keeps levels 1 to 3).
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

LEVELS = 4
VOLUME_BYTES = 1 << 30  # of one level; the finest of a 1 megapixel picture just fits
CHUNK_SHARE = 8  # features fetched at a time where there is no volume: so many times less than a volume


class CorrelationPyramid:
    """Correlation of two feature maps at four levels.

    Args:
        features0, features1: [C, H, W] in single precision.
        radius: r; (2r + 1)^2 places around a point are looked at, on each level.
        volume_bytes: Most that a level may take.
    """

    def __init__(
        self,
        features0: Float[Tensor, "C H W"],
        features1: Float[Tensor, "C H W"],
        radius: int,
        volume_bytes: int = VOLUME_BYTES,
    ) -> None:
        self.volume_bytes = volume_bytes
        channels, height, width = features0.shape
        self.queries = features0.reshape(channels, -1).T / channels**0.5
        steps = torch.arange(-radius, radius + 1, device=features0.device, dtype=torch.float32)
        # The weights expect x outside and y inside, as the authors' program orders the places.
        self.offsets = torch.stack(torch.meshgrid(steps, steps, indexing="ij"), dim=-1).reshape(-1, 2)
        self.levels: list[Tensor] = []  # volumes [HW, 1, h, w], or features [C, h, w]
        for n in range(LEVELS):
            if n:
                features1 = F.avg_pool2d(features1[None], 2, stride=2)[0]
            h, w = features1.shape[1:]
            fits = height * width * h * w * features1.element_size() <= volume_bytes
            volume = (self.queries @ features1.reshape(channels, -1)).view(-1, 1, h, w) if fits else features1
            self.levels.append(volume)

    def around(self, points: Float[Tensor, "H W 2"]) -> Float[Tensor, "channels H W"]:
        """Correlation of each pixel with the places around its point (x, y) in the second map, level by level."""
        height, width = points.shape[:2]
        at = points.reshape(-1, 1, 2)
        found = [self._look(level, at / 2**n + self.offsets) for n, level in enumerate(self.levels)]
        return torch.cat(found, dim=1).T.reshape(-1, height, width)

    def _look(self, level: Tensor, at: Float[Tensor, "n k 2"]) -> Float[Tensor, "n k"]:
        span = at.new_tensor([level.shape[-1] - 1, level.shape[-2] - 1])
        grid = 2 * at / span - 1
        if level.dim() == 4:
            return F.grid_sample(level, grid[:, None], align_corners=True)[:, 0, 0]
        size = max(1, self.volume_bytes // CHUNK_SHARE // (len(level) * at.shape[1] * level.element_size()))
        return torch.cat(
            [
                torch.einsum("nc,cnk->nk", q, F.grid_sample(level[None], g[None], align_corners=True)[0])
                for q, g in zip(self.queries.split(size), grid.split(size), strict=True)
            ]
        )
