"""Optical flow as training needs it: where each pixel was in the picture before, without lens distortion.

Positions are in pixels of an ideal pinhole picture PUBLISHED_WIDTH wide, so that losses do not depend on resolution.
"""

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from devrf.flow.store import BEST, CameraFlow
from devrf.reconstruct.rendering.rays import RaySet

PUBLISHED_WIDTH = 400.0


class PixelFlow:
    """Backward flow of the pictures of a ray set.

    Args:
        rays: The pictures' rays.
        flows: By camera.
        weighted: Tell vectors apart by how far they can be trusted; else all that are valid are alike.
    Attributes:
        pictures: How many pictures have flow.
    """

    def __init__(self, rays: RaySet, flows: dict[str, CameraFlow], weighted: bool = False) -> None:
        self.rays = rays
        entry = {
            (name, int(index)): (flow, n)
            for name, flow in flows.items()
            for n, index in enumerate(flow.index)
        }
        number = {(f.camera_name, f.index): n for n, f in enumerate(rays.frames)}
        previous, first, vectors, confidence, agreement, size = [], [], [], [], [], 0
        for n, (frame, camera) in enumerate(zip(rays.frames, rays.cameras, strict=True)):
            before = max((i for c, i in number if c == frame.camera_name and i < frame.index), default=None)
            found = entry.get((frame.camera_name, frame.index))
            if found is None or before is None or found[0].flow.shape[1:3] != (camera.height, camera.width):
                previous.append(n)
                first.append(-1)
                continue
            previous.append(number[(frame.camera_name, before)])
            first.append(size)
            vectors.append(found[0].flow[found[1]].reshape(-1, 2))
            confidence.append(_confidence(*found, weighted).reshape(-1))
            agreement.append(_agreement(*found).reshape(-1))
            size += camera.width * camera.height
        self.pictures = len(vectors)
        device = rays.device
        self.previous, self.first = torch.tensor(previous, device=device), torch.tensor(first, device=device)
        self.vectors = torch.from_numpy(np.concatenate(vectors or [np.zeros((1, 2), np.float16)])).to(device)
        self.confidence = torch.from_numpy(np.concatenate(confidence or [np.zeros(1, np.uint8)])).to(device)
        self.agreement = torch.from_numpy(np.concatenate(agreement or [np.zeros(1, np.uint8)])).to(device)
        self.width = torch.tensor([c.width for c in rays.cameras], device=device)
        self.height = torch.tensor([c.height for c in rays.cameras], device=device)
        focal = [[c.K[i, i] * PUBLISHED_WIDTH / c.width for i in (0, 1)] for c in rays.cameras]
        self.focal = torch.tensor(focal, dtype=torch.float32, device=device)

    def at(
        self, frame: Int[Tensor, " n"], pixel: Int[Tensor, " n"]
    ) -> tuple[Float[Tensor, "n 2"], Int[Tensor, " n"], Float[Tensor, " n"], Float[Tensor, " n"]]:
        """Where pixels were, in which picture, how far that can be trusted, and how far pictures agree.

        Both from 0, not at all, to 1.
        """
        has = self.first[frame] >= 0
        index = torch.where(has, self.first[frame] + pixel, 0)
        width, height = self.width[frame], self.height[frame]
        flow = self.vectors[index].float()
        at = torch.stack([pixel % width, pixel // width], dim=-1) + flow  # pixel centres at whole numbers
        inside = ((at >= 0) & (at <= torch.stack([width, height], dim=-1) - 1)).all(-1)
        direction = self._direction(frame, at)
        target = direction[:, :2] / direction[:, 2:] * self.focal[frame]
        confidence, agreement = (x[index].float() / BEST for x in (self.confidence, self.agreement))
        return target, self.previous[frame], (has & inside) * confidence, agreement

    def project(self, points: Float[Tensor, "S 3"], frame: Int[Tensor, " S"]) -> Float[Tensor, "S 2"]:
        """Pinhole projection into the cameras of pictures, relative to the principal point."""
        local = torch.einsum("nji,nj->ni", self.rays.rotations[frame], points - self.rays.centres[frame])
        return local[:, :2] / local[:, 2:].clamp(min=1e-3) * self.focal[frame]

    def _direction(self, frame: Tensor, at: Tensor) -> Tensor:
        """Viewing directions at fractional pixels, bilinear in the cameras' tables."""
        width, height = self.width[frame], self.height[frame]
        x = torch.minimum(at[:, 0].clamp(min=0), width - 1.0)
        y = torch.minimum(at[:, 1].clamp(min=0), height - 1.0)
        i, j = x.floor().long().clamp(max=width - 2), y.floor().long().clamp(max=height - 2)
        u, v = (x - i)[:, None], (y - j)[:, None]
        table, row = self.rays.directions, self.rays.table_of[frame] + j * width + i
        top = table[row] * (1 - u) + table[row + 1] * u
        bottom = table[row + width] * (1 - u) + table[row + width + 1] * u
        return top * (1 - v) + bottom * v


def _confidence(flow: CameraFlow, n: int, weighted: bool) -> UInt8[np.ndarray, "height width"]:
    """Of entry `n`, 0 to 15."""
    if weighted and flow.confidence is not None:
        return flow.confidence[n]
    return BEST * flow.valid[n].astype(np.uint8)


def _agreement(flow: CameraFlow, n: int) -> UInt8[np.ndarray, "height width"]:
    """Of entry `n`, 0 to 15; the best where pictures were not asked."""
    if flow.agreement is not None:
        return flow.agreement[n]
    return np.full(flow.valid[n].shape, BEST, np.uint8)
