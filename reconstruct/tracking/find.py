"""From a scene at rest and its fixed cameras to rigid parts, their motion, and the voxels that are theirs."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.progress import Progress, no_progress
from devrf.flow.estimator import FlowEstimator
from devrf.reconstruct.adapt.sizing import Decision
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.movers import Movers
from devrf.reconstruct.rendering.model import DynamicModel, render_layers
from devrf.reconstruct.rendering.rays import pixel_directions
from devrf.reconstruct.sampling.clean_plate import FEWEST_PICTURES, plate, standing_clips
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.tracking.follow import SurfaceTracks, follow_both_ways
from devrf.reconstruct.tracking.hidden import fill, hidden_at_rest, labels_of_hidden
from devrf.reconstruct.tracking.moving_points import moving_points
from devrf.reconstruct.tracking.offsets import FEWEST_CAMERAS
from devrf.reconstruct.tracking.rigid import motion_of, rigid_parts
from devrf.reconstruct.tracking.soft import soft_motion_of
from devrf.reconstruct.tracking.solver.graph import Graph
from devrf.reconstruct.tracking.surface import SurfacePoints, surface_at_rest, views_at_rest
from devrf.reconstruct.tracking.views.film import CameraFilm, films

FEWEST_POINTS = 60  # that move
OWN = 5.0  # spacings: voxels farther from every surface point stand
# Of a part's points: what is lost belongs to what it hung on, so a limb is a piece of a part when it is lost.
LOST_SHARE = 0.25
SOLID = 0.5  # opacity of what stands from which it hides what is behind
# Voxels; share of the points that have moved by so much when moments say anything.
STILL, MOVING_SHARE = 0.75, 0.05


class AtRest(NamedTuple):
    """The scene at rest, as training cameras see it.

    Attributes:
        surface: Its points, in the box frame.
        hidden: Vertices behind surfaces in all views.
    """

    surface: SurfacePoints
    hidden: Bool[Tensor, "X Y Z"]


@dataclass(frozen=True)
class TrackedParts:
    """What was found to move.

    Attributes:
        surface: Points that move, at rest.
        tracks: Where they are.
        labels: Part of each, counted from 0.
        stands: The scene at rest without them.
        movers: The parts, not trained.
        offsets_s: Seconds by which cameras took their pictures later than their clocks say; only where that is clear.
    """

    surface: SurfacePoints
    tracks: SurfaceTracks
    labels: Int[np.ndarray, " p"]
    stands: Canonical
    movers: Movers
    offsets_s: dict[str, float]

    def softened(self) -> "TrackedParts":
        """The same, but parts may also stretch."""
        voxel = self.movers.canonical.voxel
        motions = [
            soft_motion_of(*part, voxel) for part in _each_part(self.surface, self.tracks, self.labels)
        ]
        every = (np.stack(parts, axis=1) for parts in zip(*motions, strict=True))
        R, S, t = (torch.from_numpy(x).float() for x in every)
        return replace(self, movers=replace(self.movers, rotations=R, stretches=S, shifts=t))

    def told(self, box_from_world: Float[np.ndarray, "4 4"]) -> list[dict[str, Any]]:
        """Of each part its number, where it rests, its points, how far they go and how long it is lost.

        Lost: the most moments in a row in which pictures show something else where more than a quarter of the part
        should be. How far is a median over points; lengths and places in world units.
        """
        world_from_box, out = np.linalg.inv(box_from_world), []
        scale = float(np.cbrt(np.linalg.det(world_from_box[:3, :3])))
        for m in range(self.movers.parts):
            mine = self.labels == m
            rests = self.surface.xyz[mine]
            way = np.linalg.norm(self.tracks.xyz[:, mine] - rests, axis=-1).max(0)
            lost = self.tracks.lost[:, mine].mean(1) > LOST_SHARE
            runs = np.diff(np.flatnonzero(~np.r_[False, lost, False])) - 1
            at = world_from_box @ np.append(rests.mean(0), 1.0)
            out.append(
                {
                    "part": m + 1,
                    "at": at[:3].round(3).tolist(),
                    "points": int(mine.sum()),
                    "goes": round(float(np.median(way)) * scale, 4),
                    "longest_lost": int(runs.max()),
                }
            )
        return out


def why_not_tracked(scene: Scene, rest: RestModel) -> str | None:
    """Why movers cannot be tracked; None where they can: a rest that clips show, seen by cameras that stand."""
    if rest.canonical.ndc is not None:
        return "the scene is forward-facing"
    if scene.background != "shell":
        return "the background is plain, or cut off by mattes"
    if scene.rest_time is None:
        return "no clip shows the scene at rest"
    standing = len(standing_clips(scene))
    if standing < FEWEST_CAMERAS:
        return (
            f"training cameras that stand, with {FEWEST_PICTURES} pictures or more: {standing}, at least "
            f"{FEWEST_CAMERAS} are needed"
        )
    return None


def find_movers(
    scene: Scene,
    rest: RestModel,
    estimator: FlowEstimator,
    progress: Progress = no_progress,
    checkpoint: Checkpoint = NOWHERE,
    log: TrainingLog | None = None,
) -> tuple[TrackedParts | None, list[Decision]]:
    """Rigid parts and their motion, None where too little moves; and what was decided.

    Args:
        scene: In the box frame; `why_not_tracked` has nothing against it.
        rest: The scene at rest; stays as it is.
        estimator: Of optical flow.
        progress: Told how far it is.
        checkpoint: Where the state of tracking is kept, and taken up from.
        log: Counts the seconds, those before it was killed too.
    Raises:
        OutOfTime: The time for all is over; the state is kept.
    """
    assert scene.rest_time is not None
    clips = films(scene, estimator)
    seen = at_rest(scene, rest)
    surface = seen.surface
    progress(0.1, f"{len(surface)} points at rest")
    if len(surface) < FEWEST_POINTS:
        return None, []
    moves = moving_points(surface, clips, scene.rest_time)
    if moves.sum() < FEWEST_POINTS:
        return None, []
    progress(0.2, f"{int(moves.sum())} of {len(surface)} points move")
    region = _region(rest.canonical, surface, moves)
    stands = rest.canonical.only(~region)
    clips = [_with_what_stands(scene, film, replace(rest, canonical=stands)) for film in clips]
    graph = Graph(surface.only(moves))
    tracks, decisions = follow_both_ways(
        graph,
        clips,
        scene.rest_time,
        lambda share: progress(0.25 + 0.65 * share, "tracking"),
        checkpoint,
        log,
    )
    return parts_of(scene, rest, seen, moves, graph, tracks), decisions


def at_rest(scene: Scene, rest: RestModel) -> AtRest:
    """What a scene in the box frame shows at rest."""
    views = views_at_rest(scene, rest)
    return AtRest(surface_at_rest(views, rest), hidden_at_rest(views, rest.canonical))


def parts_of(
    scene: Scene,
    rest: RestModel,
    seen: AtRest,
    moves: Bool[np.ndarray, " n"],
    graph: Graph,
    tracks: SurfaceTracks,
) -> TrackedParts | None:
    """Rigid parts that explain tracks of the points that move, by a graph of these; None where too few go anywhere."""
    moving, voxel = graph.surface, rest.canonical.voxel
    when = _while_moving(tracks, moving, voxel)
    labels = rigid_parts(moving.xyz, tracks.xyz[when], tracks.lost[when], graph.links, voxel)
    kept, labels = _that_move(moving, tracks, labels, voxel)
    if kept.sum() < FEWEST_POINTS:
        return None
    going = moves.copy()
    going[moves] = kept
    region = _region(rest.canonical, seen.surface, going)
    moving, tracks = moving.only(kept), tracks.only(kept)
    span_s = scene.t1_s - scene.t0_s
    movers = movers_of(rest.canonical, region, seen.hidden, moving, tracks, labels)
    offsets = zip(standing_clips(scene), tracks.offsets.tolist(), strict=True)
    return TrackedParts(
        moving,
        tracks,
        labels,
        rest.canonical.only(movers.labels == 0),
        movers,
        {name: offset * span_s for name, offset in offsets if offset},
    )


def movers_of(
    canonical: Canonical,
    region: Bool[Tensor, "X Y Z"],
    hidden: Bool[Tensor, "X Y Z"],
    surface: SurfacePoints,
    tracks: SurfaceTracks,
    labels: Int[np.ndarray, " p"],
) -> Movers:
    """Parts with the rigid motions that explain their points' tracks: the region's vertices, and hidden ones."""
    motions = [motion_of(*of_part) for of_part in _each_part(surface, tracks, labels)]
    rotations, shifts = (np.stack(parts, axis=1) for parts in zip(*motions, strict=True))
    of_vertex = torch.zeros(canonical.shape, dtype=torch.uint8, device=canonical.density.device)
    places = vertices(canonical.aabb, canonical.shape)[region.cpu()].numpy()
    nearest = KDTree(surface.xyz).query(places)[1]
    of_vertex[region] = torch.from_numpy(labels[nearest] + 1).to(of_vertex)
    of_vertex += labels_of_hidden(canonical, hidden & ~region, surface.xyz, labels)
    own = canonical.only(of_vertex > 0)
    fill(own, region, (of_vertex > 0) & ~region)
    times, R, t = (torch.from_numpy(x).float() for x in (tracks.times, rotations, shifts))
    return Movers(own, of_vertex, times, R, t)


def _each_part(
    surface: SurfacePoints, tracks: SurfaceTracks, labels: Int[np.ndarray, " p"]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each part its points at rest, where they are, and when they are lost."""
    for m in range(labels.max() + 1):
        mine = labels == m
        yield surface.xyz[mine], tracks.xyz[:, mine].astype(float), tracks.lost[:, mine]


def _region(
    canonical: Canonical, surface: SurfacePoints, moves: Bool[np.ndarray, " n"]
) -> Bool[Tensor, "X Y Z"]:
    """Vertices near the surface whose nearest point moves."""
    near = canonical.distance <= 1
    places = vertices(canonical.aabb, canonical.shape)[near.cpu()].numpy()
    distance, nearest = KDTree(surface.xyz).query(places)
    region = torch.zeros_like(near)
    region[near] = torch.from_numpy(moves[nearest] & (distance < OWN * surface.spacing)).to(near)
    return region


def _with_what_stands(scene: Scene, film: CameraFilm, stands: RestModel) -> CameraFilm:
    """The film with its depth and its plate: where nothing changes, what it shows; elsewhere the model's picture."""
    picture, depth, opacity = render_layers(DynamicModel(stands), film.camera, None)
    axis = film.camera.cam_from_world[2, :3]
    along = depth / np.maximum(opacity, SOLID) * (pixel_directions(film.camera) @ axis)
    own, known = plate(replace(scene, image_scale=film.scale), film.frames)
    shown = np.where(known[..., None], own.astype(np.float32) / 255, picture)
    return replace(film, depth=np.where(opacity > SOLID, along, np.inf), plate=shown.astype(np.float32))


def _that_move(
    surface: SurfacePoints, tracks: SurfaceTracks, labels: Int[np.ndarray, " p"], voxel: float
) -> tuple[Bool[np.ndarray, " p"], Int[np.ndarray, " k"]]:
    """Points of parts that go anywhere, and their parts, counted anew; the others stand, whatever changed there."""
    farthest = np.linalg.norm(tracks.xyz - surface.xyz, axis=-1).max(0)
    goes = np.array([np.median(farthest[labels == m]) > STILL * voxel for m in range(labels.max() + 1)])
    kept = goes[labels]
    return kept, np.unique(labels[kept], return_inverse=True)[1]


def _while_moving(tracks: SurfaceTracks, surface: SurfacePoints, voxel: float) -> Bool[np.ndarray, " t"]:
    """Moments at which something has moved; all where nothing ever has."""
    away = np.linalg.norm(tracks.xyz - surface.xyz, axis=-1)
    moved = np.percentile(away, 100 * (1 - MOVING_SHARE), axis=1) > STILL * voxel
    return moved if moved.any() else ~moved
