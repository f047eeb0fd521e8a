"""How much of a scene moves."""

import torch

from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.motion import MotionField

AT_ONCE = 1 << 18  # points


@torch.no_grad()
def moving_voxels(canonical: Canonical, motion: MotionField) -> int:
    """Occupied voxels of the scene at rest that are more than a voxel away from there at any key time."""
    device = canonical.distance.device
    lo, hi = canonical.aabb.to(device)
    occupied = (canonical.distance == 0).nonzero()
    points = lo + occupied / (torch.tensor(canonical.shape, device=device) - 1) * (hi - lo)
    moving = 0
    for x in points.split(AT_ONCE):
        moved = torch.zeros(len(x), dtype=torch.bool, device=device)
        for key in range(motion.keys):
            first = min(key, motion.keys - 2)
            pair = motion.window(first, first + 1, device)
            there = pair.from_rest(x, torch.full_like(x[:, 0], key - first))
            moved |= (there - x).norm(dim=1) > canonical.voxel
        moving += int(moved.sum())
    return moving
