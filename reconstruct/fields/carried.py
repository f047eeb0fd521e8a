"""Which part carries a point, where the point rests, and the motion of parts as fields."""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import Movers, Placed
from devrf.reconstruct.kernels.occupancy import REACH


def to_rest(
    movers: Movers, x: Float[Tensor, "n 3"], placed: Placed, within: int = 1
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """Where points seen in the first picture of `placed` rest, and their part; 0: none is so near, they stand.

    Args:
        movers: The parts.
        x: Points.
        placed: Where the parts are.
        within: Voxels from a part in which points are taken for its own.
    """
    back = placed.back[0]
    return _nearest(movers, within, x, lambda m: (x - placed.shifts[0, m]) @ back[m].mT)


def part_of(movers: Movers, x_rest: Float[Tensor, "n 3"], within: int = 1) -> Int[Tensor, " n"]:
    """The part of resting points."""
    return _nearest(movers, within, x_rest, lambda m: x_rest)[1]


def field_of(movers: Movers, keys: int, rest_time: float, resolution: float) -> MotionField:
    """The same motion as fields: exact at vertices on a part or next to one, none elsewhere.

    Args:
        movers: The parts and their motion.
        keys: Number of key times.
        rest_time: In [0, 1]; the key nearest to it counts as that of rest, however far parts have moved by then.
        resolution: As `MotionField.still`.
    """
    first, last = float(movers.times[0]), float(movers.times[-1])
    rest_key = round((rest_time - first) / (last - first) * (keys - 1))
    device = movers.canonical.density.device
    field = MotionField.still(box_of(movers), keys, resolution, (first, last), rest_key, str(device))
    shape = field.backward.shape[1:]
    x = vertices(field.aabb, (shape[0], shape[1], shape[2])).reshape(-1, 3).to(device)
    part = part_of(movers, x, REACH - 1)
    for key, time in enumerate(field.key_times):
        placed = movers.placed(torch.tensor([time]))
        field.backward[key] = (to_rest(movers, x, placed, REACH - 1)[0] - x).reshape(shape)
        field.forward[key] = (placed.carried(x, part) - x).reshape(shape)
    return field


def box_of(movers: Movers) -> Float[Tensor, "2 3"]:
    """The box of the scene at rest and all places at which parts ever are; on the CPU."""
    places = vertices(movers.canonical.aabb, movers.canonical.shape)
    corners = [movers.canonical.aabb]
    forth = movers.rotations @ movers.stretched()
    for m in range(movers.parts):
        own = places[movers.labels.cpu() == m + 1]
        if len(own):
            ends = torch.cartesian_prod(*torch.stack([own.amin(0), own.amax(0)], dim=1))
            corners.append((ends @ forth[:, m].mT + movers.shifts[:, m, None]).reshape(-1, 3))
    every = torch.cat(corners)
    return torch.stack([every.amin(0), every.amax(0)])


def _nearest(
    movers: Movers, within: int, x: Float[Tensor, "n 3"], rested: Callable[[int], Float[Tensor, "n 3"]]
) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    """Points as the nearest part has them at rest, and the part; as they are, and 0, where none is near."""
    out, part = x.clone(), torch.zeros(len(x), dtype=torch.int64, device=x.device)
    least = torch.full((len(x),), within + 1, dtype=torch.uint8, device=x.device)
    for m in range(movers.parts):
        x0 = rested(m)
        away = _away(movers, m, x0)
        nearer = away < least
        least[nearer], out[nearer], part[nearer] = away[nearer], x0[nearer], m + 1
    return out, part


def _away(movers: Movers, part: int, x_rest: Float[Tensor, "n 3"]) -> UInt8[Tensor, " n"]:
    """Voxels from resting points to a part, at most REACH."""
    first, away = movers.distances()[part]
    lo, hi = movers.canonical.aabb.to(x_rest)
    last = torch.tensor(movers.canonical.shape, device=x_rest.device) - 1
    at = ((x_rest - lo) / (hi - lo) * last).round().long() - first
    end = torch.tensor(away.shape, device=x_rest.device)
    inside = ((at >= 0) & (at < end)).all(-1)
    at = torch.where(inside[:, None], at, 0)
    return torch.where(inside, away[tuple(at.unbind(-1))], REACH)
