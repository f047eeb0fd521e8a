"""Exports of a coloured point cloud per time.

Points are what rendered views show, not samples of the density: a level of the density lies up to half a voxel outside
the surface, the depth of a view in its middle.
"""

from typing import Any

from devrf.capture.formats.geometry.ply import write_ply
from devrf.capture.system.errors import ReconstructError
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import AXES, ExportedModel, entry_of

TIMES = "10"


def write(request: Request) -> None:
    """Write `points_0000.ply` and so on, one per time."""
    trained = ExportedModel(request, TIMES)
    from devrf.reconstruct.geometry.cloud import point_cloud
    from devrf.reconstruct.geometry.seen import look, poses, solid

    model, cameras = solid(trained.model), poses(trained.boxed)
    entries: list[dict[str, Any]] = []
    with request.new_folder() as new, request.talk.progress("export ply") as progress:
        for n, moment in enumerate(trained.moments):
            views = []
            for k, camera in enumerate(cameras):
                views.append(look(model, camera, moment.time))
                done = (n + (k + 1) / len(cameras)) / len(trained.moments)
                progress(done, f"time {n + 1} of {len(trained.moments)}")
            cloud = point_cloud(views)
            if not len(cloud.xyz):
                raise ReconstructError(
                    "model-without-surface",
                    f"{request.run_dir}: the model shows no surface {moment.said()}; look at it with render, and train "
                    "longer",
                )
            path = new / f"points_{n:04d}.ply"
            xyz = trained.to_world(cloud.xyz)
            comments = trained.comments("point cloud", moment)
            write_ply(path, xyz, trained.turned_to_world(cloud.normals), cloud.rgb, comments)
            entries.append(entry_of(path, moment, xyz, points=len(xyz)))
        trained.describe(
            new,
            files="points_0000.ply and so on: one cloud per time, in order (times in export.json). Positions, normals, "
            "8-bit sRGB colours.",
            axes=AXES,
            facts={"files": entries, "views": len(cameras)},
        )
