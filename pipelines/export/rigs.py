"""Exports of the cameras alone, as a calibration."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.rigs.given import read_given
from devrf.calibration.rigs.rig import read_rig
from devrf.capture.camera import Camera
from devrf.capture.errors import CaptureError
from devrf.capture.formats.export import README
from devrf.capture.formats.round_trip import POINTS, RoundTrip, of_rig
from devrf.pipelines.export.request import Request

TEXT = """Cameras of a devrf rig.

Axes: OpenCV's (x right, y down, z forward), world to camera. Lengths: {unit}.
Read again with calibration.rig.given in scene.yaml.
"""


def write(request: Request) -> None:
    """Write the rig of a run in one of `RIG_WRITERS`' formats, and read it back."""
    rig = read_rig(request.run_dir / "rig" / "rig.json")
    cameras = {name: c.camera for name, c in rig.cameras.items()}
    with request.new_folder() as new:
        RIG_WRITERS[request.name](new, cameras, rig.scale.metric)
        request.notes.append(_checked(cameras, new, request.name).said("the calibration"))
        if not rig.scale.metric:
            request.notes.append(
                "lengths have an arbitrary scale; programs that take them for metres are wrong"
            )
        text = TEXT.format(unit="metres" if rig.scale.metric else rig.scale.source)
        (new / README).write_text(text + "".join(f"\nNote: {note}.\n" for note in request.notes))


def _checked(cameras: Mapping[str, Camera], folder: Path, where: str) -> RoundTrip:
    """What is read back against what was meant, seen from the first camera: some formats have no other world.

    Raises:
        CaptureError: They differ.
    """
    first, *more = folder.iterdir()
    source = first if first.is_file() and not more else folder
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    given = read_given(source, list(cameras), sizes, "m")
    if given.rig is None:
        raise CaptureError(f"{where}: read back, it has no poses; nothing is left there; please report this")
    again = _from_first({name: c.camera for name, c in given.rig.cameras.items()})
    meant = _from_first(cameras)
    return of_rig(_seen(meant), [(meant[name], again[name]) for name in meant], where)


def _from_first(cameras: Mapping[str, Camera]) -> dict[str, Camera]:
    first = next(iter(cameras.values())).cam_from_world
    return {name: camera.moved(np.vstack([first, [0, 0, 0, 1.0]])) for name, camera in cameras.items()}


def _seen(cameras: Mapping[str, Camera]) -> Float[np.ndarray, "n 3"]:
    """Points about where the cameras look, as far before them as they stand apart."""
    centres = np.array([camera.centre for camera in cameras.values()])
    apart = float(np.linalg.norm(centres - centres[0], axis=1).max()) or 1.0
    looked_at = centres + apart * np.array([camera.cam_from_world[2, :3] for camera in cameras.values()])
    lo, hi = looked_at.min(axis=0) - apart / 4, looked_at.max(axis=0) + apart / 4
    return np.random.default_rng(0).uniform(lo, hi, (POINTS, 3))
