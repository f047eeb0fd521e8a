"""`devrf-pipeline export`: the calibrated scene of a run, written as a data set for other programs."""

import difflib
from pathlib import Path

from devrf.capture.errors import CaptureError, InputError
from devrf.capture.formats import DATASET_FORMATS, DatasetFormat, read_scene, write_dataset
from devrf.capture.formats.export import check_target
from devrf.capture.formats.flow_files import Flow
from devrf.capture.scene import PosedFrame
from devrf.flow.store import read_flows
from devrf.pipelines.console import Talk
from devrf.pipelines.stamp import STAMP


def export(talk: Talk, run_dir: Path, dataset_format: str, out: Path | None) -> Path:
    """Write the scene of a run as a data set and say where it is.

    Args:
        talk: Where to speak.
        run_dir: The run folder.
        dataset_format: One of `DATASET_FORMATS`.
        out: Folder to write; None: `export/<format>` in the run folder.
    Raises:
        InputError: Seen before anything is written: an unknown format, a folder in use, no scene yet.
        CaptureError: The format cannot hold this scene, or a picture is missing.
    """
    chosen = _format(dataset_format)
    folder = run_dir / "export" / chosen if out is None else out.expanduser().resolve()
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

    try:
        with talk.progress(f"export {chosen}") as progress:
            notes = write_dataset(chosen, scene, folder, find_flow, progress)
    except OSError as error:
        raise CaptureError(
            f"{folder}: cannot be written ({error.strerror or error}); nothing is left there; free space or name "
            "another folder with --out"
        ) from None
    for text in notes:
        talk.say(f"  note: {text}")
    talk.say(f"  data set ({chosen}): {folder}")
    return folder


def _format(name: str) -> DatasetFormat:
    for known in DATASET_FORMATS:
        if name == known:
            return known
    near = difflib.get_close_matches(name, DATASET_FORMATS, n=1)
    hint = f", did you mean {near[0]}?" if near else ""
    raise InputError(f"--format {name}: expected {', '.join(DATASET_FORMATS)}{hint}")
