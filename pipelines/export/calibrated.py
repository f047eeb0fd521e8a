"""Exports of what was calibrated: the scene as a data set, or the cameras alone."""

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.rigs.rig import read_rig
from devrf.capture.formats import write_dataset
from devrf.capture.formats.parts.export import README
from devrf.pipelines.export.request import Request
from devrf.pipelines.run_folder.trained_model import trained_scene

TEXT = """Cameras of a devrf rig.

Axes: OpenCV's (x right, y down, z forward), world to camera. Lengths: {unit}.
Read again with calibration.rig.given in scene.yaml.
"""


def write_scene(request: Request) -> None:
    """Write the scene of a run as a data set."""
    name, scene = request.name, trained_scene(request.run_dir)
    with request.disk_told(), request.talk.progress(f"export {name}") as progress:
        request.notes = write_dataset(name, scene, request.folder, progress, request.notes)


def write_cameras(request: Request) -> None:
    """Write the rig of a run in one of `RIG_WRITERS`' formats."""
    rig = read_rig(request.run_dir / "rig" / "rig.json")
    cameras = {name: c.camera for name, c in rig.cameras.items()}
    with request.new_folder() as new:
        RIG_WRITERS[request.name](new, cameras, rig.scale.metric)
        if not rig.scale.metric:
            request.notes.append(
                "lengths have an arbitrary scale; programs that take them for metres are wrong"
            )
        text = TEXT.format(unit="metres" if rig.scale.metric else rig.scale.source)
        (new / README).write_text(text + "".join(f"\nNote: {note}.\n" for note in request.notes))
