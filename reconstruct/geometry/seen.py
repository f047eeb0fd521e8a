"""What cameras see of the model at a time: pictures with the place of the surface behind every pixel.

Views are rendered, so every pose of a training camera can be asked at every time. A pixel shows a surface where the
box is nearly opaque; it is left out where the surface is seen edge-on, where the mean depth of a pixel lies in the
air between two things.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.system.spread import spread
from devrf.reconstruct.fields.canonical import EMPTY
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.geometry.camera_arc import fixed_cameras
from devrf.reconstruct.geometry.field import Field, colours_from_outside
from devrf.reconstruct.rendering.model import DynamicModel, render_layers
from devrf.reconstruct.rendering.rays import pixel_directions
from devrf.reconstruct.sampling.pictures import training

SOLID = 0.9  # opacity from which a pixel shows a surface
GRAZING = 0.15  # cosine to the surface's normal below which its depth is not trusted: 81 degrees
SAME_SURFACE = 0.02  # of the distance: how far a point may lie from what a view sees there and be it
MOST_OF_SWEEP, MOST_FIXED = 8, 12  # poses, spread over the sweep; moving cameras
MOST_PIXELS = 60_000  # of a view: a pixel is then smaller than a voxel of the smallest models


@dataclass(frozen=True)
class SeenView:
    """A rendered view.

    Attributes:
        camera: In the box frame.
        picture: RGB in [0, 1].
        points: Surface behind each pixel, in the box frame; NaN where there is none.
        normals: Unit normals of the surface there, towards the camera.
        kept: Pixels whose surface is to be trusted.
    """

    camera: Camera
    picture: Float32[np.ndarray, "h w 3"]
    points: Float[np.ndarray, "h w 3"]
    normals: Float[np.ndarray, "h w 3"]
    kept: Bool[np.ndarray, "h w"]


def solid(model: DynamicModel) -> DynamicModel:
    """The model without the last of its planes (`ndc.py`), on which every ray ends: what is behind everything."""

    def without(rest: RestModel) -> RestModel:
        canonical = copy.copy(rest.canonical)
        canonical.density = canonical.density.clone()
        canonical.density[:, :, -1] = EMPTY
        canonical.rebuild_occupancy(within=canonical.distance == 0)
        return replace(rest, canonical=canonical)

    if model.rest.canonical.ndc is None:
        return model
    in_motion = None if model.in_motion is None else without(model.in_motion)
    return DynamicModel(without(model.rest), model.motion, in_motion, chunk=model.chunk)


def poses(scene: Scene, of_sweep: int = MOST_OF_SWEEP) -> list[Camera]:
    """Cameras to look with, small: training poses spread over the sweep, and those of the moving cameras.

    Args:
        scene: In the box frame.
        of_sweep: Most poses of the sweep.
    """
    chosen = [f.camera for f in spread(training(scene.static), of_sweep)]
    chosen += spread(list(fixed_cameras(scene).values()), MOST_FIXED)
    return [c.scaled(min(scene.image_scale, np.sqrt(MOST_PIXELS / (c.width * c.height)))) for c in chosen]


def look(model: DynamicModel, camera: Camera, time: float | None) -> SeenView:
    """Render what a camera in the box frame sees at a time in [0, 1]; None: at rest."""
    picture, depth, opacity = render_layers(model, camera, time)
    away = np.where(opacity > SOLID, depth / np.maximum(opacity, SOLID), np.nan)
    rays_d = pixel_directions(camera)
    points = camera.centre + away[..., None] * rays_d
    normals = _normals(points)
    facing = -(normals * rays_d).sum(-1)
    normals = normals * np.where(facing < 0, -1.0, 1.0)[..., None]
    return SeenView(camera, picture, points, normals, np.abs(np.nan_to_num(facing)) > GRAZING)


def colours_of(
    views: Sequence[SeenView],
    field: Field,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Colours of surface points in [0, 1] as the views show them, head-on views most.

    Args:
        views: At the field's time.
        field: Asked where no view shows a point: as seen head-on.
        points: In the box frame.
        normals: Outward unit normals there.
    """
    total, weights = np.zeros((len(points), 3)), np.zeros(len(points))
    for view in views:
        at, weight = _shown(view, points, normals)
        seen = weight > 0
        total[seen] += weight[seen, None] * view.picture[at[seen, 1], at[seen, 0]]
        weights += weight
    shown = weights > 0
    colours = total / np.where(shown, weights, 1.0)[:, None]
    if not shown.all():
        colours[~shown] = colours_from_outside(field, points[~shown], normals[~shown])
    return colours


def agreed(views: Sequence[SeenView], n: int) -> Bool[np.ndarray, "h w"]:
    """Kept pixels of view `n` whose point other views see too, more of them than see something behind it.

    A pixel at the edge of a thing has a depth between it and what is behind: a point in the air.
    """
    kept, points = views[n].kept, views[n].points[views[n].kept]
    votes = np.zeros(len(points), int)
    for view in (*views[:n], *views[n + 1 :]):
        at, inside, distance = _where(view, points)
        surface = np.linalg.norm(view.points[at[:, 1], at[:, 0]] - view.camera.centre, axis=1)
        surface = np.where(np.isnan(surface), np.inf, surface)  # through the whole box
        votes += inside & (np.abs(distance - surface) < SAME_SURFACE * distance)
        votes -= inside & (surface > (1 + SAME_SURFACE) * distance)
    out = np.zeros_like(kept)
    out[kept] = votes > 0
    return out


def _where(
    view: SeenView, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "n 2"], Bool[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The pixel (column, row) of each point, whether it is in the picture, and its distance."""
    camera = view.camera
    pixel = np.nan_to_num(camera.project(points), nan=-1.0)
    inside = np.all((pixel >= 0) & (pixel < [camera.width, camera.height]), axis=-1)
    at = np.where(inside[:, None], pixel, 0).astype(int)
    return at, inside, np.linalg.norm(points - camera.centre, axis=1)


def _shown(
    view: SeenView, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The pixel of each point, and how much the view says of it: 0 where it is outside, turned away or hidden."""
    at, inside, distance = _where(view, points)
    facing = -(normals * (points - view.camera.centre)).sum(1) / distance
    surface = np.linalg.norm(view.points[at[:, 1], at[:, 0]] - view.camera.centre, axis=1)
    free = inside & view.kept[at[:, 1], at[:, 0]] & (facing > GRAZING)
    free &= np.abs(distance - surface) < SAME_SURFACE * distance
    return at, np.where(free, facing**2, 0.0)


def _normals(points: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Across the differences to the neighbours; NaN where one of them, or the point, is missing."""
    along = np.full_like(points, np.nan)
    down = np.full_like(points, np.nan)
    along[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = np.where(np.isfinite(points), np.cross(along, down), np.nan)
    return normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
