"""Export of the surface as a triangle mesh that moves (`glb`)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.capture.formats.geometry import gltf
from devrf.capture.system.errors import InputError, ReconstructError
from devrf.capture.system.progress import Progress
from devrf.capture.system.spread import spread
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.times import KEYS
from devrf.pipelines.export.trained import ExportedModel, bounds_of

if TYPE_CHECKING:  # it needs torch
    from torch import Tensor

    from devrf.reconstruct.fields.movers import Movers
    from devrf.reconstruct.geometry.seen import SeenView
    from devrf.reconstruct.rendering.model import DynamicModel

STANDS = "what stands"
COMPARED = 5  # moments at which meshes that move are held against the surface then
GLTF_FROM_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # y up; the front looks along +z
GLTF_AXES = (
    "glTF's: x right, y up, the front along +z. Vertices are in the world of the calibration, as in the other exports "
    "of this run; the node's rotation brings the direction that the cameras were held by to y."
)


def write(request: Request) -> None:
    """Write `scene.glb`: the mesh at rest, moved by the forward motion; movers are meshes of their own."""
    level, trained = _level(request), ExportedModel(request, KEYS)
    from devrf.reconstruct.geometry.seen import solid

    model = solid(trained.model)
    with request.new_folder() as new, request.talk.progress("export glb") as progress:
        make = _one_mesh if model.movers is None else _rigid_meshes
        made = make(trained, model, level, progress)
        turn = GLTF_FROM_UPRIGHT @ trained.upright_from_world
        start = made.times_s[0] if made.times_s else 0.0
        extras = {"unit": trained.unit, "axes": GLTF_AXES, "first_time_s": start}
        times_s = [time_s - start for time_s in made.times_s]
        gltf.write_glb(new / "scene.glb", made.meshes, times_s, turn, request.title, extras)
        counts = {
            name: sum(len(getattr(mesh, name)) for mesh in made.meshes) for name in ("vertices", "faces")
        }
        trained.describe(
            new,
            files=f"scene.glb: {made.said}; the animation `motion` plays them; its second 0 is {start:.4f} s. "
            f"{_made(level)} Colours are per vertex, unlit.",
            axes=GLTF_AXES,
            facts={
                "files": [{"file": "scene.glb"} | counts],
                "level": level,
                "crumbs_left_out": made.crumbs,
                "first_time_s": start,
                "key_times_s": made.times_s,
                "gltf_from_world": turn.tolist(),
                **made.facts,
                **bounds_of(made.reached),
            },
        )


@dataclass(frozen=True)
class _Made:
    """What goes into a glb.

    Attributes:
        meshes: In the world.
        times_s: Key times; empty where nothing moves.
        crumbs: Small pieces that were left out.
        reached: All vertices at rest and at all key times [n, 3].
        said: What the meshes are, in words.
        facts: More for programs.
    """

    meshes: list[gltf.GltfMesh]
    times_s: list[float]
    crumbs: int
    reached: np.ndarray
    said: str
    facts: dict[str, Any]


def _one_mesh(trained: ExportedModel, model: "DynamicModel", level: float, progress: Progress) -> _Made:
    """All in one, whose shape changes."""
    from devrf.reconstruct.geometry.field import field_at
    from devrf.reconstruct.geometry.mesh_surface import apart, coloured, moved, surface_of

    moments = trained.moments if model.motion is not None else []
    at_rest = field_at(model, trained.moments[0].time).at_rest()
    base = surface_of(at_rest, level, marching_cubes)
    rgb = coloured(_views(trained, model, progress), base, at_rest)
    vertices, shapes, misses = trained.to_world(base.vertices), [], []
    for n, moment in enumerate(moments):
        field = field_at(model, moment.time)
        shapes.append(trained.to_world(moved(base, field)))
        anew = surface_of(field, level, marching_cubes)
        misses.append(apart(shapes[-1], trained.to_world(anew.vertices)))
        progress(0.5 + 0.5 * (n + 1) / len(moments), f"time {n + 1} of {len(moments)}")
    return _Made(
        [gltf.GltfMesh("scene", vertices, base.faces, rgb, shapes)],
        [moment.time_s or 0.0 for moment in moments],
        base.crumbs,
        np.concatenate([vertices, *shapes]),
        "the mesh at rest and, as morph targets, where the forward motion takes it at each key time",
        {"forward_motion": _agreement(trained, misses)} if misses else {},
    )


def _rigid_meshes(trained: ExportedModel, model: "DynamicModel", level: float, progress: Progress) -> _Made:
    """What stands, and each part on a node that moves as it does in the model, at all its moments."""
    import torch

    from devrf.reconstruct.geometry.field import Field, field_at
    from devrf.reconstruct.geometry.mesh_surface import apart, coloured, surface_of

    assert model.movers is not None and model.in_motion is not None
    movers, views = model.movers, _views(trained, model, progress)
    times = [moment.time or 0.0 for moment in trained.moments]
    times_s = [moment.time_s or 0.0 for moment in trained.moments]
    ways = _ways(trained, movers, torch.tensor(times))
    meshes, moved, crumbs, empty = [], [], 0, []
    for part in range(movers.parts + 1):
        name = f"part {part}" if part else STANDS
        progress(0.5 + 0.4 * part / (movers.parts + 1), name)
        field = Field(movers.only((part,)).canonical if part else model.in_motion.canonical)
        try:
            found = surface_of(field, level, marching_cubes)
        except ReconstructError:  # nothing of it is that opaque
            empty.append(name)
            continue
        crumbs += found.crumbs
        way, vertices = ways[part - 1] if part else None, trained.to_world(found.vertices)
        meshes.append(gltf.GltfMesh(name, vertices, found.faces, coloured(views, found, field), way=way))
        moved.append(np.repeat(vertices[None], len(times), axis=0) if way is None else way.carried(vertices))
    if not meshes:
        text = f"nothing solid found at level {level:g}; give another --level"
        raise ReconstructError("model-without-surface", text)
    if empty:
        trained.request.notes.append(
            f"without {', '.join(empty)}: nothing of it is that opaque, or only crumbs"
        )
    shapes, misses = np.concatenate(moved, axis=1), []
    for n in spread(range(len(times)), COMPARED):
        progress(0.9 + 0.1 * n / len(times), f"compared at {times_s[n]:.2f} s")
        anew = surface_of(field_at(model, times[n]), level, marching_cubes)
        misses.append(apart(shapes[n], trained.to_world(anew.vertices)))
    return _Made(
        meshes,
        times_s,
        crumbs,
        np.concatenate([mesh.vertices for mesh in meshes] + list(shapes)),
        f"what stands, and {movers.parts} parts, each a mesh of its own on a node that turns and goes"
        + ("" if movers.stretches is None else " and stretches"),
        {"parts": movers.parts, "forward_motion": _agreement(trained, misses)},
    )


def _ways(trained: ExportedModel, movers: "Movers", times: "Tensor") -> list[gltf.Way]:
    """Of the parts, in the world. They turn about their middles, as they do between the moments of the model."""
    placed = movers.placed(times)
    R, forth, t = (
        x.double().cpu().numpy().swapaxes(0, 1) for x in (placed.rotations, placed.forth, placed.shifts)
    )
    S = None if placed.stretches is None else placed.stretches.double().cpu().numpy().swapaxes(0, 1)
    turn, out = trained.world_from_box[:3, :3] / trained.scale, []
    for m, middle in enumerate(movers.middles()):
        places = trained.to_world(np.einsum("kij,j->ki", forth[m], middle) + t[m])
        stretches = None if S is None else turn @ S[m] @ turn.T
        out.append(gltf.Way(trained.to_world(middle[None])[0], turn @ R[m] @ turn.T, places, stretches))
    return out


def marching_cubes(volume: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Level set of a volume, by scikit-image (Lewiner et al. 2003)."""
    from skimage import measure

    vertices, faces, _, _ = measure.marching_cubes(volume, level, gradient_direction="ascent")
    return vertices, faces.astype(np.int64)


def _made(level: float) -> str:
    return (
        f"The surface is where a layer of a voxel's thickness absorbs {level:g} of the light; where the "
        "scene's box cuts a thing the mesh is open."
    )


def _level(request: Request) -> float:
    from devrf.reconstruct.geometry.mesh_surface import LEVEL

    level = LEVEL if request.options.level is None else request.options.level
    if not 0 < level < 1:
        text = f"--level {level:g}: expected an opacity between 0 and 1, such as {LEVEL:g}"
        raise InputError("option-out-of-range", text)
    return level


def _views(trained: ExportedModel, model: "DynamicModel", progress: Progress) -> "list[SeenView]":
    """What training poses see of the scene at rest, in the colours that it has in motion."""
    from devrf.reconstruct.geometry.mesh_surface import resting
    from devrf.reconstruct.geometry.seen import look, poses

    still, cameras, views = resting(model), poses(trained.boxed), []
    for n, camera in enumerate(cameras):
        views.append(look(still, camera, None))
        progress(0.5 * (n + 1) / len(cameras), f"colours: view {n + 1} of {len(cameras)}")
    return views


def _agreement(trained: ExportedModel, misses: list[np.ndarray]) -> dict[str, Any]:
    """How far the mesh that moves lies from the surface of each time, in the world; told."""
    medians, most = ([float(np.quantile(m, q)) for m in misses] for q in (0.5, 0.95))
    unit = "m" if trained.scene.metric else "units"
    canonical = trained.model.rest.canonical
    # in a frustum they have no one size
    voxel = canonical.voxel * trained.scale if canonical.ndc is None else None
    beside = "" if voxel is None else f"; a voxel is {voxel:.2g} {unit}"
    trained.request.notes.append(
        f"the mesh that the forward motion moves lies within {max(medians):.2g} {unit} (median of vertices, worst key "
        f"time) and {max(most):.2g} {unit} (95 %) of the surface extracted anew at that time{beside}"
    )
    return {"median": medians, "percentile_95": most, "voxel": voxel}
