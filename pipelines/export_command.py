"""`devrf-pipeline export`: the calibrated scene of a run as a data set, or its cameras as a calibration."""

import difflib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.rigs.rig import read_rig
from devrf.capture.errors import CaptureError, InputError
from devrf.capture.formats import DATASET_FORMATS, DatasetFormat, read_scene, write_dataset
from devrf.capture.formats.export import README, check_target, new_folder
from devrf.capture.formats.flow_files import Flow
from devrf.capture.scene import PosedFrame
from devrf.flow.store import read_flows
from devrf.pipelines.console import Talk
from devrf.pipelines.runner.own_folder import check_run_folder
from devrf.pipelines.stamps.stamp import STAMP

RIG_README = """Cameras of a devrf rig.

Axes: OpenCV's (x right, y down, z forward), world to camera. Lengths: {unit}.
Read again with calibration.rig.given in scene.yaml.
"""


def export(talk: Talk, run_dir: Path, dataset_format: str, out: Path | None) -> Path:
    """Write the scene or the rig of a run and say where it is.

    Args:
        talk: Where to speak.
        run_dir: The run folder.
        dataset_format: One of `DATASET_FORMATS` (the scene) or of `RIG_WRITERS` (the rig).
        out: Folder to write; None: `export/<format>` in the run folder.
    Raises:
        InputError: An unknown format, a folder in use, no scene or rig yet, a lens that the format lacks, or a link in
            the run folder.
        CaptureError: The format cannot hold this scene, a picture is missing, or nothing can be written.
    """
    name = _known(dataset_format)
    if out is None:
        check_run_folder(run_dir, ())
    folder = run_dir / "export" / name if out is None else out.expanduser().resolve()
    for scene_format in DATASET_FORMATS:
        if name == scene_format:
            _export_scene(talk, run_dir, scene_format, folder)
            return folder
    _export_rig(talk, run_dir, name, folder)
    return folder


def _export_rig(talk: Talk, run_dir: Path, name: str, folder: Path) -> None:
    if not (run_dir / "rig" / STAMP).is_file():
        raise InputError(f"{run_dir}: the rig has not been made yet; run with --until rig")
    rig = read_rig(run_dir / "rig" / "rig.json")
    with _told(folder), new_folder(folder, name) as new:
        RIG_WRITERS[name](new, {n: c.camera for n, c in rig.cameras.items()}, rig.scale.metric)
        (new / README).write_text(RIG_README.format(unit="metres" if rig.scale.metric else rig.scale.source))
    if not rig.scale.metric:
        talk.say("  note: lengths have an arbitrary scale; programs that take them for metres are wrong")
    talk.say(f"  calibration ({name}): {folder}")


def _export_scene(talk: Talk, run_dir: Path, chosen: DatasetFormat, folder: Path) -> None:
    if not (run_dir / "scene" / STAMP).is_file():
        raise InputError(
            f"{run_dir}: the scene has not been made yet; run with --until scene (or flow) first"
        )
    check_target(folder, chosen)
    scene = read_scene(run_dir / "scene")
    has_flow = chosen == "devrf" and (run_dir / "flow" / STAMP).is_file()
    flows = read_flows(run_dir / "flow") if has_flow else {}
    places = {name: {n: k for k, n in enumerate(flow.index.tolist())} for name, flow in flows.items()}

    def find_flow(frame: PosedFrame) -> Flow | None:
        place = places.get(frame.camera_name, {}).get(frame.index)
        if place is None:
            return None
        flow = flows[frame.camera_name]
        return flow.flow[place].astype("float32"), flow.valid[place]

    with _told(folder), talk.progress(f"export {chosen}") as progress:
        notes = write_dataset(chosen, scene, folder, find_flow, progress)
    for text in notes:
        talk.say(f"  note: {text}")
    talk.say(f"  data set ({chosen}): {folder}")


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """A disk that is full or may not be written, in words."""
    try:
        yield
    except OSError as error:
        raise CaptureError(
            f"{folder}: cannot be written ({error.strerror or error}); nothing is left there; free space or name "
            "another folder with --out"
        ) from None


def _known(name: str) -> str:
    known = [*DATASET_FORMATS, *RIG_WRITERS]
    if name in known:
        return name
    near = difflib.get_close_matches(name, known, n=1)
    hint = f", did you mean {near[0]}?" if near else ""
    raise InputError(f"--format {name}: expected {', '.join(known)}{hint}")
