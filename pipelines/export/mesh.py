"""Exports of the surface as a triangle mesh: one per time (`mesh`), or one that moves (`glb`)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from devrf.capture.errors import InputError
from devrf.capture.formats import gltf, obj, ply
from devrf.capture.progress import Progress
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.times import KEYS
from devrf.pipelines.export.trained import AXES, Trained, bounds_of

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.geometry.seen import SeenView
    from devrf.reconstruct.model import DynamicModel

TIMES = "10"
GLTF_FROM_UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # y up; the front looks along +z
GLTF_AXES = (
    "glTF's: x right, y up, the front along +z. Vertices are in the world of the calibration, as in the other exports "
    "of this run; the node's rotation brings the direction that the cameras were held by to y."
)


def write(request: Request) -> None:
    """Write `mesh_0000.ply` and `mesh_0000.obj` and so on, one pair per time."""
    level, trained = _level(request), Trained(request, TIMES)
    from devrf.reconstruct.geometry.field import field_at
    from devrf.reconstruct.geometry.seen import solid
    from devrf.reconstruct.geometry.surface import coloured, normals_of, surface_of

    model = solid(trained.model)
    entries: list[dict[str, Any]] = []
    with request.new_folder() as new, request.talk.progress("export mesh") as progress:
        views = _views(trained, model, progress)
        for n, moment in enumerate(trained.moments):
            field = field_at(model, moment.time)
            found = surface_of(field, level, marching_cubes)
            rgb, xyz = coloured(views, found, field), trained.to_world(found.vertices)
            normals = normals_of(xyz, found.faces)
            comments = ["devrf mesh in the world of the calibration", f"unit: {trained.unit}", moment.said()]
            stem = f"mesh_{n:04d}"
            ply.write_ply(new / f"{stem}.ply", xyz, normals, rgb, found.faces, comments)
            obj.write_obj(new / f"{stem}.obj", xyz, normals, rgb, found.faces, comments)
            entries.append(
                {
                    "files": [f"{stem}.ply", f"{stem}.obj"],
                    "time": moment.time,
                    "time_s": moment.time_s,
                    "vertices": len(xyz),
                    "faces": len(found.faces),
                    "crumbs_left_out": found.crumbs,
                    **bounds_of(xyz),
                }
            )
            progress(0.5 + 0.5 * (n + 1) / len(trained.moments), f"time {n + 1} of {len(trained.moments)}")
        trained.describe(
            new,
            files="mesh_0000.ply, mesh_0000.obj and so on: the same mesh twice for each time, in order (times in "
            f"export.json). {_made(level)} Each time has a mesh of its own; glb has one that moves. Colours "
            "are sRGB, per vertex.",
            axes=AXES,
            facts={"files": entries, "level": level},
        )


def write_glb(request: Request) -> None:
    """Write `scene.glb`: the mesh at rest, moved by the forward motion."""
    level, trained = _level(request), Trained(request, KEYS)
    from devrf.reconstruct.geometry.field import field_at
    from devrf.reconstruct.geometry.seen import solid
    from devrf.reconstruct.geometry.surface import apart, coloured, moved, surface_of

    model = solid(trained.model)
    with request.new_folder() as new, request.talk.progress("export glb") as progress:
        moments = trained.moments if model.motion is not None else []
        at_rest = field_at(model, trained.moments[0].time).at_rest()
        base = surface_of(at_rest, level, marching_cubes)
        rgb = coloured(_views(trained, model, progress), base, at_rest)
        shapes, misses = [], []
        for n, moment in enumerate(moments):
            field = field_at(model, moment.time)
            shapes.append(moved(base, field))
            misses.append(apart(shapes[-1], surface_of(field, level, marching_cubes).vertices))
            progress(0.5 + 0.5 * (n + 1) / len(moments), f"time {n + 1} of {len(moments)}")
        turn = GLTF_FROM_UPRIGHT @ trained.upright_from_world
        start = moments[0].time_s or 0.0 if moments else 0.0
        times_s = [(moment.time_s or 0.0) - start for moment in moments]
        world = [trained.to_world(shape) for shape in shapes]
        mesh = gltf.AnimatedMesh(trained.to_world(base.vertices), base.faces, rgb, world, times_s, turn)
        extras = {"unit": trained.unit, "axes": GLTF_AXES, "first_time_s": start}
        gltf.write_glb(new / "scene.glb", mesh, request.title, extras)
        facts: dict[str, Any] = {
            "files": [{"file": "scene.glb", "vertices": len(base.vertices), "faces": len(base.faces)}],
            "level": level,
            "crumbs_left_out": base.crumbs,
            "first_time_s": start,
            "key_times_s": [moment.time_s for moment in moments],
            "gltf_from_world": turn.tolist(),
            **bounds_of(np.concatenate([mesh.vertices, *mesh.shapes])),
        }
        if misses:
            facts["forward_motion"] = _agreement(trained, misses)
        trained.describe(
            new,
            files="scene.glb: the mesh at rest and, as morph targets, where the forward motion takes it at each key "
            f"time; the animation `motion` plays them; its second 0 is {start:.4f} s. {_made(level)} Colours are "
            "per vertex, unlit.",
            axes=GLTF_AXES,
            facts=facts,
        )


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
    from devrf.reconstruct.geometry.surface import LEVEL

    level = LEVEL if request.options.level is None else request.options.level
    if not 0 < level < 1:
        text = f"--level {level:g}: expected an opacity between 0 and 1, such as {LEVEL:g}"
        raise InputError("option-out-of-range", text)
    return level


def _views(trained: Trained, model: "DynamicModel", progress: Progress) -> "list[SeenView]":
    """What training poses see of the scene at rest, in the colours that it has in motion."""
    from devrf.reconstruct.geometry.seen import look, poses
    from devrf.reconstruct.geometry.surface import resting

    still, cameras, views = resting(model), poses(trained.boxed), []
    for n, camera in enumerate(cameras):
        views.append(look(still, camera, None))
        progress(0.5 * (n + 1) / len(cameras), f"colours: view {n + 1} of {len(cameras)}")
    return views


def _agreement(trained: Trained, misses: list[np.ndarray]) -> dict[str, Any]:
    """How far the mesh that moves lies from the surface of each time; told."""
    medians, most = ([float(np.quantile(m, q)) * trained.scale for m in misses] for q in (0.5, 0.95))
    unit = "m" if trained.scene.metric else "units"
    canonical = trained.model.rest.canonical
    voxel = (
        canonical.voxel * trained.scale if canonical.ndc is None else None
    )  # in a frustum they have no one size
    beside = "" if voxel is None else f"; a voxel is {voxel:.2g} {unit}"
    trained.request.notes.append(
        f"the mesh that the forward motion moves lies within {max(medians):.2g} {unit} (median of vertices, worst key "
        f"time) and {max(most):.2g} {unit} (95 %) of the surface extracted anew at that time{beside}"
    )
    return {"median": medians, "percentile_95": most, "voxel": voxel}
