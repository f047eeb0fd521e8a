"""Exports of the calibrated scene as a data set."""

from devrf.capture.formats import write_dataset
from devrf.pipelines.export.request import Request
from devrf.pipelines.trained_scene import trained_scene


def write(request: Request) -> None:
    """Write the scene of a run as a data set."""
    name, scene = request.name, trained_scene(request.run_dir)
    with request.disk_told(), request.talk.progress(f"export {name}") as progress:
        request.notes = write_dataset(name, scene, request.folder, progress, request.notes)
