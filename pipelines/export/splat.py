"""Exports of 3D Gaussians, a PLY file per time."""

from typing import Any

from devrf.capture.formats.ply import write_splat_ply
from devrf.pipelines.export import splats as shared
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import AXES, Trained, bounds_of

TIMES = "10"
LAST = 0.05  # of the progress: writing


def write(request: Request) -> None:
    """Write `splat_0000.ply` and so on, one per time; the same Gaussians in the same order."""
    count = shared.asked(request)
    trained = Trained(request, TIMES)
    import torch

    from devrf.reconstruct.splats.gaussians import transformed

    matrix = torch.from_numpy(trained.world_from_box).float()
    entries: list[dict[str, Any]] = []
    with request.new_folder() as new, request.talk.progress("export splat") as progress:
        made = shared.made(trained, count, lambda done, text: progress((1 - LAST) * done, text))
        for n, moment in enumerate(trained.moments):
            world, path = transformed(made.at(n).to("cpu"), matrix), new / f"splat_{n:04d}.ply"
            xyz = world.places.numpy()
            comments = [
                "devrf splats in the world of the calibration",
                f"unit: {trained.unit}",
                moment.said(),
            ]
            write_splat_ply(
                path,
                xyz,
                world.colours.numpy(),
                world.logits.numpy(),
                world.log_scales.numpy(),
                world.quats.numpy(),
                comments,
            )
            entries.append(
                {"file": path.name, "time": moment.time, "time_s": moment.time_s, **bounds_of(xyz)}
            )
            progress(1 - LAST + LAST * (n + 1) / len(trained.moments), f"{n + 1} files written")
        trained.describe(
            new,
            files="splat_0000.ply and so on: 3D Gaussians as 3D Gaussian splatting writes them, one file per time, in "
            "order (times in export.json). The same Gaussians in the same order in all files; only positions differ, "
            "of rigid parts orientations too. Colours do not depend on the direction (SH degree 0).",
            axes=AXES,
            facts={
                "files": entries,
                "splats": len(made.gaussians),
                "moving": made.moving,
                "behind": made.behind.tolist(),
            },
        )
