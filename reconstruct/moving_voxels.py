"""How much of a scene moves."""

import torch

from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.motion import MotionField

AT_ONCE = 1 << 18  # points


@torch.no_grad()
def moving_voxels(canonical: Canonical, motion: MotionField) -> int:
    """Voxels, of the size of those at rest, in which something is that moves, at any of the key times.

    What stays within a voxel of where it rests does not count.
    """
    device = canonical.distance.device
    lo, hi = canonical.aabb.to(device)
    occupied = (canonical.distance == 0).nonzero()
    points = lo + occupied / (torch.tensor(canonical.shape, device=device) - 1) * (hi - lo)
    begin, end = motion.aabb.to(device)
    shape = [int(n) + 1 for n in ((end - begin) / canonical.voxel).ceil()]
    passed = torch.zeros(shape, dtype=torch.bool, device=device)
    for key in range(motion.keys):
        first = min(key, motion.keys - 2)
        pair = motion.window(first, first + 1, device)
        for x in points.split(AT_ONCE):
            there = pair.from_rest(x, torch.full_like(x[:, 0], key - first))
            there = there[(there - x).norm(dim=1) > canonical.voxel]
            voxel = ((there.clamp(begin, end) - begin) / canonical.voxel).long()
            passed[tuple(voxel.T)] = True
    return int(passed.sum())
