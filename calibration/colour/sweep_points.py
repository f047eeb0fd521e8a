"""Points that the sweep and a fixed camera both see.

The sweep's sparse points are projected into the fixed camera's clean picture. Each is compared with the sweep picture
that shows it from the most similar place; whether both really show it is told by their patches.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.calibration.colour.surface import Pairs, View, shared_colours
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.camera import Camera
from devrf.capture.frames import SWEEP
from devrf.capture.photos.resize import shrink

MOST_POINTS = 3000  # of a camera, those that the sweep's model knows best
MOST_PICTURES = 40  # of the sweep that are read for a camera: a second or two
WIDEST_DEG = 40.0  # between the two lines of sight; beyond, even matt surfaces change
DISTANCE_PER_OCTAVE_DEG = 10.0  # twice the distance counts as much as so many degrees
SIGHTED_SIDE_PX = 640  # of pictures in which points are only recognised
MAX_ERROR_PX = 2.0  # mean reprojection error of a point


@dataclass(frozen=True)
class SweepPoints:
    """The sweep's points, and the pictures that show them.

    Attributes:
        model: The sweep.
        factor: From its unit to the fixed cameras'.
        read: The picture of a name in the model.
    """

    model: SweepModel
    factor: float
    read: Callable[[str], UInt8[np.ndarray, "_ _ 3"]]


def sweep_pairs(name: str, view: View, sweep: SweepPoints) -> Pairs:
    """Colours of a fixed camera's points in the sweep (first) and in its clean picture (second).

    Args:
        name: Of the camera.
        view: Its clean picture.
        sweep: The points.
    """
    colours, place = [np.zeros((0, 2, 3))], [np.zeros((0, 2))]
    for xyz, swept, seen in _by_picture(view.camera, sweep):
        found, usable = shared_colours(xyz, swept, view, (seen, None))
        colours.append(found[usable])
        place.append(view.camera.project(xyz[usable]) / view.camera.width)
    return Pairs(SWEEP, name, np.concatenate(colours), np.concatenate(place))


def sweep_sightings(
    camera: Camera, pictures: Sequence[UInt8[np.ndarray, "h w 3"]], sweep: SweepPoints
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, "pictures n"]]:
    """Where a fixed camera should see the sweep's points, pixels, and in which of its pictures it does."""
    views = [_small(View(camera, rgb)) for rgb in pictures]
    places, found = [np.zeros((0, 2))], [np.zeros((len(pictures), 0), bool)]
    for xyz, swept, seen in _by_picture(camera, sweep):
        small = _small(swept)
        at = seen * (small.camera.width / swept.camera.width)
        places.append(camera.project(xyz))
        usable = [shared_colours(xyz, small, view, (at, None))[1] for view in views]
        found.append(np.array(usable, dtype=bool).reshape(len(views), len(xyz)))
    return np.concatenate(places), np.concatenate(found, axis=1)


def _small(view: View) -> View:
    """The same with a longer side of at most `SIGHTED_SIDE_PX`."""
    scale = SIGHTED_SIDE_PX / max(view.camera.width, view.camera.height)
    if scale >= 1:
        return view
    camera = view.camera.scaled(scale)
    return View(camera, shrink(view.rgb, camera.width, camera.height))


def _by_picture(
    camera: Camera, sweep: SweepPoints
) -> Iterator[tuple[Float[np.ndarray, "n 3"], View, Float[np.ndarray, "n 2"]]]:
    """Points that a camera may see, by the picture of the sweep they are compared with, and where that shows them."""
    unit = np.diag([*[sweep.factor] * 3, 1.0])
    cameras = [swept.moved(unit) for swept in sweep.model.cameras]
    points, picture, seen = _best_views(camera, sweep.model, sweep.factor, cameras)
    counts = np.bincount(picture, minlength=len(cameras))
    for n in np.argsort(counts)[::-1][:MOST_PICTURES]:
        mine = picture == n
        if not mine.any():
            break
        yield points[mine], View(cameras[n], sweep.read(sweep.model.names[n])), seen[mine]


def _best_views(
    camera: Camera, model: SweepModel, factor: float, cameras: list[Camera]
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray, Float[np.ndarray, "n 2"]]:
    """Points in view, for each the most similar of the sweep's pictures, and where that shows it."""
    xyz = factor * model.xyz
    at = camera.project(xyz)
    inside = ((at > 0) & (at < [camera.width, camera.height])).all(axis=1) & (model.error_px < MAX_ERROR_PX)
    track = np.bincount(model.obs_point, minlength=len(xyz))
    kept = np.zeros(len(xyz), dtype=bool)
    kept[np.flatnonzero(inside)[np.argsort(-track[inside], kind="stable")[:MOST_POINTS]]] = True
    of = np.flatnonzero(kept[model.obs_point])
    centres, focal = np.array([c.centre for c in cameras]), np.array([c.K[0, 0] for c in cameras])
    point, picture = model.obs_point[of], model.obs_image[of]
    theirs, ours = centres[picture] - xyz[point], camera.centre - xyz[point]
    far = [np.linalg.norm(v, axis=1) for v in (theirs, ours)]
    cosine = (theirs * ours).sum(axis=1) / np.maximum(far[0] * far[1], 1e-12)
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    octaves = np.abs(np.log2((far[0] / focal[picture]) / (far[1] / camera.K[0, 0])))
    cost = np.where(angle < WIDEST_DEG, angle + DISTANCE_PER_OCTAVE_DEG * octaves, np.inf)
    order = np.lexsort((cost, point))
    best = order[np.flatnonzero(np.diff(point[order], prepend=-1))]  # the first of each point
    best = best[np.isfinite(cost[best])]
    return xyz[point[best]], picture[best], model.obs_xy[of[best]].astype(np.float64)
