"""Whether a camera path leaves what is known: pictures from where nobody looked, and cameras where nothing can be seen.

A place is *outside* if the direction from the target to it is farther than `FREE_DEG` from that of every training
camera, or if it is much nearer to the target or farther from it than all of them. Pictures from there can be made,
but show what training never saw.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.reconstruct.film.span import film_cameras, focus
from devrf.reconstruct.geometry.field import field_at
from devrf.reconstruct.grids import vertices
from devrf.reconstruct.kernels.march import RaySegments
from devrf.reconstruct.model import DynamicModel
from devrf.reconstruct.ndc import NEAR
from devrf.reconstruct.pictures import spread, training

FREE_DEG = 15.0
FREE_NEARER, FREE_FARTHER = 0.6, 1.5  # times the least and the largest distance of a training camera
SOLID = 0.5  # opacity of a step from which a place is inside of something
# of surroundings that hide what is behind them, box units: inside of them whichever way one looks
THICK = 0.1
MOST_POINTS = 4000  # of what is solid at rest that a camera's distance is taken from


@dataclass(frozen=True)
class Leaving:
    """What is to be said of a path.

    Attributes:
        outside: Pictures from outside.
        farthest_deg: Largest angle of a picture from the nearest training camera.
        cut: Pictures in which something solid lies nearer than the nearest distance at which anything is shown.
        unseen: Places in the path of cameras from which nothing can be shown: inside of something solid, or farther
            from the box than any camera saw.
    """

    outside: int
    farthest_deg: float
    cut: int
    unseen: tuple[int, ...]


def leaving(
    scene: Scene, model: DynamicModel, path: Sequence[Camera], times: Sequence[float | None]
) -> Leaving:
    """Look at every camera of a path; scene and path in the box frame."""
    target = focus(film_cameras(scene), scene.aabb)
    known = np.array([f.camera.centre for f in (*training(scene.static), *training(scene.dynamic))])
    places = np.array([camera.centre for camera in path])
    degrees, ratio = _apart(places - target, np.unique(known.round(6), axis=0) - target)
    outside = (degrees > FREE_DEG) | (ratio < FREE_NEARER) | (ratio > FREE_FARTHER)
    solid = np.array([_in_solid(model, place, time) for place, time in zip(places, times, strict=True)])
    far = np.linalg.norm(np.clip(places, *scene.aabb) - places, axis=1) > model.rest.far
    cut = _nearest_solid(model, places) < model.rest.near
    return Leaving(
        int(outside.sum()),
        float(degrees.max()),
        int((cut & ~solid & ~far).sum()),
        tuple(np.flatnonzero(solid | far).tolist()),
    )


def _apart(
    places: Float[np.ndarray, "n 3"], known: Float[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Degrees to the nearest known direction; distance over the least or largest known one, 1 between them."""
    lengths, reach = np.linalg.norm(places, axis=1), np.linalg.norm(known, axis=1)
    directions = places / np.maximum(lengths, 1e-12)[:, None]
    cosines = (directions @ (known / reach[:, None]).T).max(axis=1)
    ratio = lengths / np.clip(lengths, reach.min(), reach.max())
    return np.degrees(np.arccos(np.clip(cosines, -1, 1))), ratio


@torch.no_grad()
def _in_solid(model: DynamicModel, place: Float[np.ndarray, "3"], time: float | None) -> bool:
    rest = model.rest
    canonical, ndc = rest.canonical, rest.canonical.ndc
    device = canonical.density.device
    x = torch.tensor(place[None], dtype=torch.float32, device=device)
    if ndc is not None:
        # rays begin on the near plane: from behind it they would begin before it
        return bool(place[2] >= NEAR)
    lo, hi = canonical.aabb.to(x)
    if bool(((x >= lo) & (x <= hi)).all()):
        return bool(canonical.alpha(field_at(model, time).to_rest(x)) > SOLID)
    if rest.shell is None:
        return False
    middle, zero = x.new_full((3,), 0.5), x.new_zeros(3)
    across = RaySegments(x - THICK / 2 * torch.eye(3).to(x), torch.eye(3).to(x), zero, zero + THICK, middle)
    _, through, _ = rest.shell.render(across, False)
    return bool((through < 1 - SOLID).all())


@torch.no_grad()
def _nearest_solid(model: DynamicModel, places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance to what is solid in the box at rest; infinite where that is not asked."""
    canonical = model.rest.canonical
    if canonical.ndc is not None:
        return np.full(len(places), np.inf)
    points = vertices(canonical.aabb, canonical.shape).reshape(-1, 3)
    occupied = (canonical.distance.reshape(-1) == 0).cpu().nonzero()[:, 0]
    some = points[torch.tensor(spread(occupied.tolist(), 10 * MOST_POINTS), dtype=torch.int64)]
    solid = (canonical.alpha(some.to(canonical.density)) > SOLID).cpu()
    found = spread(some[solid].tolist(), MOST_POINTS)
    if not found:
        return np.full(len(places), np.inf)
    return np.linalg.norm(places[:, None] - np.array(found)[None], axis=2).min(axis=1)
