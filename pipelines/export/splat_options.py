"""Exports of 3D Gaussians, a PLY file per time; and how many there are and how they are made, for the player too."""

from typing import TYPE_CHECKING, Any

from devrf.capture.formats.geometry.ply import GaussianVertices, write_splat_ply
from devrf.capture.system.errors import InputError
from devrf.capture.system.progress import Progress, part
from devrf.pipelines.export.request import Request
from devrf.pipelines.export.trained import AXES, ExportedModel, entry_of

if TYPE_CHECKING:  # it needs torch
    from devrf.reconstruct.splats.make import Splats

COUNT = 30_000  # about what software WebGL plays 20 times a second (docs/player.md)
FEWEST, MOST = 500, 2_000_000
TIMES = "10"
LAST = 0.05  # of the progress: writing


def write(request: Request) -> None:
    """Write `splat_0000.ply` and so on, one per time; the same Gaussians in the same order."""
    count = asked(request)
    trained = ExportedModel(request, TIMES)
    import torch

    from devrf.reconstruct.splats.gaussians import transformed

    matrix = torch.from_numpy(trained.world_from_box).float()
    entries: list[dict[str, Any]] = []
    with request.new_folder() as new, request.talk.progress("export splat") as progress:
        fitted = made(trained, count, part(progress, 0.0, 1 - LAST))
        for n, moment in enumerate(trained.moments):
            world, path = transformed(fitted.at(n).to("cpu"), matrix), new / f"splat_{n:04d}.ply"
            xyz = world.places.numpy()
            vertices = GaussianVertices(
                xyz,
                world.colours.numpy(),
                world.logits.numpy(),
                world.log_scales.numpy(),
                world.quats.numpy(),
            )
            write_splat_ply(path, vertices, trained.comments("splats", moment))
            entries.append(entry_of(path, moment, xyz))
            progress(1 - LAST + LAST * (n + 1) / len(trained.moments), f"{n + 1} files written")
        trained.describe(
            new,
            files="splat_0000.ply and so on: 3D Gaussians as 3D Gaussian splatting writes them, one file per time, in "
            "order (times in export.json). The same Gaussians in the same order in all files; only positions differ, "
            "of rigid parts orientations too. Colours do not depend on the direction (SH degree 0).",
            axes=AXES,
            facts={
                "files": entries,
                "splats": len(fitted.gaussians),
                "moving": fitted.moving,
                "behind": fitted.behind.tolist(),
            },
        )


def asked(request: Request) -> int:
    """`--splats`, or the usual number.

    Raises:
        InputError: Too few or too many.
    """
    count = COUNT if request.options.splats is None else request.options.splats
    if not FEWEST <= count <= MOST:
        text = f"--splats {count}: expected {FEWEST} to {MOST}; {COUNT} if it is left out"
        raise InputError("option-out-of-range", text)
    return count


def made(trained: ExportedModel, count: int, progress: Progress) -> "Splats":
    """Splats of the model at the times that were asked for."""
    from devrf.reconstruct.splats.make import make_splats

    times = [moment.time for moment in trained.moments]
    return make_splats(trained.boxed, trained.model, count, times, progress)
