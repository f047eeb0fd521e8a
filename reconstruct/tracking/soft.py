"""Soft parts: what bends also stretches and shears, which no rigid motion explains.

To first order, around its middle, any smooth motion of a part is a matrix: a stretch, then a turn.
"""

import numpy as np
from jaxtyping import Bool, Float

from devrf.reconstruct.tracking.rigid import motion_of, weights_of

REACH = 2.0  # voxels: where a part reaches less far than this, tracks hardly tell how it stretches
MOST = 1.5  # of a length: what seems to stretch by more, or shrinks so much, is a guess

SoftMotions = tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"]]
"""Rotation, symmetric stretch and translation at each moment."""


def soft_motion_of(
    rest: Float[np.ndarray, "p 3"],
    tracks: Float[np.ndarray, "t p 3"],
    lost: Bool[np.ndarray, "t p"],
    voxel: float,
) -> SoftMotions:
    """The motion that explains tracks best when a part may also stretch: a point x at rest is at R S x + t.

    Where few points are seen, or the part is thin, it is the rigid motion (a ridge of `REACH` voxels).

    Args:
        rest: Points at rest.
        tracks: Where they are.
        lost: When each point's place is a guess, which counts only where few others are left.
        voxel: Of the scene at rest.
    Returns:
        R, S and t at each moment.
    """
    rotations, _ = motion_of(rest, tracks, lost)
    weights, seen = weights_of(tracks, lost), (~lost).mean(1)[:, None, None]
    middle, middles = weights @ rest, np.einsum("tp,tpi->ti", weights, tracks)
    apart = rest - middle[:, None]
    ridge = (REACH * voxel) ** 2
    spread = seen * ((weights[..., None] * apart).mT @ apart)
    moved = seen * ((weights[..., None] * (tracks - middles[:, None])).mT @ apart)
    linear = (moved + ridge * rotations) @ np.linalg.inv(spread + ridge * np.eye(3))
    U, lengths, V = np.linalg.svd(linear)
    rotations = U @ V
    stretches = V.mT * lengths.clip(1 / MOST, MOST)[:, None] @ V
    return rotations, stretches, middles - np.einsum("tij,tj->ti", rotations @ stretches, middle)
