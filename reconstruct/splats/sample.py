"""First Gaussians of a model: the places of its pictures' pixels, gathered in cells, a Gaussian for each cell.

Only pictures of the scene at rest count: the sweep sees all of it, and places that the motion has to take back to
rest make a thick layer of what is a surface. A cell is as large as a number of pixels of the nearest camera, so that
what cameras were near to gets small Gaussians. Cells of the surroundings, whose distance is less sure, are deep: seen
from the middle of the box, they hold what lies behind one another. The Gaussian of a cell has the mean and the spread
of the places in it.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.system.errors import ReconstructError
from devrf.reconstruct.splats.gaussians import Gaussians, quats_of
from devrf.reconstruct.splats.looks import PlacedView

MOST_POINTS = 1_500_000  # pixels that are gathered, over all pictures
BODY_SHARE = 0.6  # of the Gaussians, where there are surroundings: what people look at
MANY = 4  # places in a cell, on average, from which one that is alone is taken to lie between two surfaces
DEEP = 8.0  # depth of a cell of the surroundings against its width
WIDER = 1.7  # Gaussians against the spread of a cell's places: the one is flat and ends, the other fades
THINNEST, WIDEST = 0.12, 0.9  # standard deviations in cells
OPACITY = 0.9
FINEST, COARSEST = -1.0, 7.0  # powers of two of pixels: cells
SEARCH = 12  # halvings of the interval between them
LEVELS = 2  # sizes of cells per doubling


def sample(looks: Sequence[PlacedView], count: int, seed: int) -> Gaussians:
    """About `count` Gaussians at rest.

    Raises:
        ReconstructError: No picture shows a surface.
    """
    places, colours, body = _points(looks, seed)
    if not len(places):
        text = "the model shows no surface; look at it with render, and train longer"
        raise ReconstructError("model-without-surface", text)
    centres = torch.stack([torch.from_numpy(look.camera.centre).to(places) for look in looks])
    focal = torch.tensor([look.camera.K[0, 0] for look in looks]).median()
    parts = []
    for which, left in ((body, BODY_SHARE * count), (~body, count)):
        if which.any():
            here = places[which]
            footprint = (
                torch.cat([torch.cdist(part, centres).amin(1) for part in here.split(1 << 16)]) / focal
            )
            share = left if not body.all() else count
            share -= sum(len(part) for part in parts)
            parts.append(_gathered(here, colours[which], footprint, int(share), which is body))
    return joined(parts)


def _gathered(places: Tensor, colours: Tensor, footprint: Tensor, count: int, is_body: bool) -> Gaussians:
    """At most about `count` Gaussians of places; fewer where the finest cells are no more."""
    divided = cells if is_body else deep_cells
    lo, hi = FINEST, COARSEST
    for _ in range(SEARCH):
        middle = (lo + hi) / 2
        cell, _ = divided(places, footprint * 2**middle)
        lo, hi = (middle, hi) if int(cell.max()) >= count else (lo, middle)
    cell, size = divided(places, footprint * 2**hi)
    return _of_cells(places, colours, size, cell)


def cells(
    places: Float[Tensor, "N 3"], size: Float[Tensor, " N"]
) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """The number of the cell each place is in, and the cells' sizes (rounded to `LEVELS` per doubling)."""
    size, level = _rounded(size)
    return _numbered(level, (places / size[:, None]).floor().long()), size


def deep_cells(
    places: Float[Tensor, "N 3"], size: Float[Tensor, " N"]
) -> tuple[Int[Tensor, " N"], Float[Tensor, " N"]]:
    """The same for cells that are `DEEP` times as long, away from the origin, as they are wide."""
    away = places.norm(dim=1).clamp(min=1e-6)
    angle, level = _rounded(size / away)
    across = (places / away[:, None] / angle[:, None]).floor().long()
    ring = (away.log() / (DEEP * angle)).floor().long()
    return _numbered(_numbered(level, across), ring[:, None].expand(-1, 3)), angle * away


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Several as one."""
    names = ("places", "quats", "log_scales", "logits", "colours")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def _rounded(size: Tensor) -> tuple[Tensor, Tensor]:
    level = (size.log2() * LEVELS).round().long()
    return 2.0 ** (level / LEVELS), level


def _numbered(level: Int[Tensor, " N"], at: Int[Tensor, "N 3"]) -> Int[Tensor, " N"]:
    """Numbers from 0 on, the same for the same level and place in a grid."""
    at = at - at.amin(0)
    extent = (at.amax(0) + 1).tolist()
    key = (((level - level.min()) * extent[0] + at[:, 0]) * extent[1] + at[:, 1]) * extent[2] + at[:, 2]
    return key.unique(return_inverse=True)[1]


def _well_filled(cell: Int[Tensor, " N"]) -> Bool[Tensor, " cells"]:
    places = torch.bincount(cell)
    return (places > 1) | (len(cell) < MANY * len(places))


def _points(looks: Sequence[PlacedView], seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Places, colours, and which are the body's, of pixels drawn from all pictures."""
    share = min(1.0, MOST_POINTS / sum(look.is_body.numel() for look in looks))
    generator = torch.Generator().manual_seed(seed)
    places, colours, body = [], [], []
    for look in looks:
        drawn = torch.rand(look.is_body.shape, generator=generator).to(look.places.device) < share
        drawn &= look.places.isfinite().all(-1)
        places.append(look.places[drawn])
        colours.append(look.picture[drawn])
        body.append(look.is_body[drawn])
    return torch.cat(places), torch.cat(colours), torch.cat(body)


def _of_cells(places: Tensor, colours: Tensor, size: Tensor, cell: Tensor) -> Gaussians:
    kept = _well_filled(cell)
    number = kept.cumsum(0) - 1
    inside = kept[cell]
    cell, places, colours, size = number[cell[inside]], places[inside], colours[inside], size[inside]
    n = int(kept.sum())
    count = torch.bincount(cell, minlength=n)

    def mean(values: Tensor) -> Tensor:
        return values.new_zeros(n, values.shape[1]).index_add_(0, cell, values) / count[:, None]

    centre = mean(places)
    apart = places - centre[cell]
    spread = mean((apart[:, :, None] * apart[:, None, :]).flatten(1)).reshape(n, 3, 3)
    edge = mean(size[:, None])
    values, vectors = torch.linalg.eigh(spread)
    vectors[:, :, 0] *= torch.linalg.det(vectors).sign()[:, None]  # a rotation, not a reflection
    scales = WIDER * values.clamp(min=0).sqrt()
    scales = torch.minimum(torch.maximum(scales, THINNEST * edge), WIDEST * edge)
    logit = torch.full((n,), OPACITY, device=places.device).logit()
    return Gaussians(centre, quats_of(vectors), scales.log(), logit, mean(colours))
