"""How points of the scene move, as arrows: from where they rest, or to where they will be."""

import numpy as np
import torch
from jaxtyping import Float

from devrf.reconstruct.geometry.field import field_at
from devrf.reconstruct.grids import vertices
from devrf.reconstruct.model import DynamicModel

CANDIDATES = 30_000  # occupied vertices that are asked, spread over the scene
SOLID = 0.1  # opacity of a step from which a vertex is a point of the scene
SHORTEST = 0.5  # voxels: less motion is no arrow


def next_key(model: DynamicModel, time: float) -> float:
    """The model's first key time after a time, in [0, 1]; the last one at the end."""
    assert model.motion is not None
    times = model.motion.key_times
    return next((t for t in times if t > time + 1e-6), times[-1])


@torch.no_grad()
def motion_arrows(
    model: DynamicModel, start: float | None, end: float, count: int
) -> Float[np.ndarray, "n 2 3"]:
    """Where moving points of the scene are at two times, at most `count` of them.

    Args:
        model: With motion.
        start, end: Times in [0, 1]; None: at rest.
    Returns:
        Start and end [n, 2, 3], box frame; none where nothing moves by half a voxel.
    """
    canonical = model.rest.canonical
    places = vertices(canonical.aabb, canonical.shape).to(canonical.density)[canonical.distance == 0]
    places = places[canonical.alpha(places) > SOLID]
    order = torch.randperm(len(places), generator=torch.Generator().manual_seed(0))[:CANDIDATES]
    rest = places[order.to(places.device)]
    ends = torch.stack([field_at(model, time).from_rest(rest) for time in (start, end)], dim=1)
    moved = (ends[:, 1] - ends[:, 0]).norm(dim=1) > SHORTEST * canonical.voxel
    ends = ends[moved][:count]
    return field_at(model, None).to_box(ends.reshape(-1, 3)).reshape(-1, 2, 3).cpu().numpy()
