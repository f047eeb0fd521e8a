"""Exports of the cameras alone, as a calibration."""

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.rigs.rig import read_rig
from devrf.capture.formats.export import README
from devrf.pipelines.export.request import Request

TEXT = """Cameras of a devrf rig.

Axes: OpenCV's (x right, y down, z forward), world to camera. Lengths: {unit}.
Read again with calibration.rig.given in scene.yaml.
"""


def write(request: Request) -> None:
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
