"""The published DeVRF layout with cameras around the subject: `static/` and `dynamic_<n>views/`, Blender's keys.

Each folder's files have their own `camera_angle_x`. `train_flow/NNN_bwd.npz` is the flow of entry NNN of
`transforms_train.json`, counted in the order of the file. A validation split is not read.
The forward-facing layout of the same name is in `devrf_forward.py`; what is there decides.
"""

import re
import shutil
from pathlib import Path

from devrf.capture.errors import CaptureError
from devrf.capture.formats.assembly import Pictures
from devrf.capture.formats.blender import at_rest, own_entry, read_split, write_splits
from devrf.capture.formats.devrf_forward import read_devrf_forward
from devrf.capture.formats.export import Export, Pinholes
from devrf.capture.formats.flow_files import flow_name, with_flow_files, write_flow_file
from devrf.capture.scene import PosedFrame


def read_devrf(folder: Path, notes: list[str]) -> Pictures:
    """Either layout of the published data sets."""
    moving = moving_folder(folder, notes)
    if (folder / "static" / "poses_bounds.npy").is_file():
        return read_devrf_forward(folder, moving, notes)
    static = folder / "static"
    at = read_split(static, "train", notes)
    has_test = (static / "transforms_test.json").is_file()
    at += read_split(static, "test", notes) if has_test else ()
    train = read_split(moving, "train", notes, moving=True)
    if (moving / "train_flow").is_dir():
        train = with_flow_files(train, lambda n: moving / "train_flow" / flow_name(n))
    has_witness = (moving / "transforms_test.json").is_file()
    test = read_split(moving, "test", notes, moving=True) if has_witness else ()
    return Pictures(
        at_rest(at),
        tuple(sorted(train + test, key=_order)),
        has_split=has_test,
        own=own_entry(moving / "transforms_train.json"),
    )


def write_devrf(export: Export) -> None:
    """`static/`, `dynamic_<n>views/` and the flow of its training pictures, entries in order of time."""
    scene = export.scene
    if not scene.static or not scene.dynamic:
        code, missing = (
            ("motion-missing", "pictures in motion") if scene.static else ("rest-missing", "sweep")
        )
        wrong = f"devrf holds a scene at rest and in motion, this scene has no {missing}"
        raise CaptureError(code, f"{wrong}; export to nerfstudio")
    write_splits(export.folder / "static", scene.static, Pinholes(export, scene.static, "static"), export)
    cameras = list(dict.fromkeys(f.camera_name for f in scene.dynamic))
    counts = [sum(f.camera_name == name and f.split == "train" for f in scene.dynamic) for name in cameras]
    views = [count for count in counts if count]
    if not views:
        text = "devrf needs training cameras of the moving scene, this scene has none"
        raise CaptureError("motion-missing", text)
    folder = export.folder / f"dynamic_{len(views)}views"
    pinholes = Pinholes(export, scene.dynamic, folder.name)
    train = write_splits(folder, _in_order_of_time(scene.dynamic, cameras), pinholes, export)
    if len(set(views)) > 1:
        export.notes.append(
            f"the cameras have {', '.join(map(str, views))} pictures; programs that count entries as view + "
            f"{len(views)} x time need equal numbers"
        )
    if all(f.split == "train" for f in scene.dynamic):
        export.notes.append("no camera was kept for tests, so dynamic has no transforms_test.json")
    _write_flow(export, folder, train, pinholes)


def _in_order_of_time(frames: tuple[PosedFrame, ...], cameras: list[str]) -> tuple[PosedFrame, ...]:
    """All cameras' first pictures, then all second ones, ..., as the published loader counts them."""
    ranked = []
    for place, name in enumerate(cameras):
        own = sorted((f for f in frames if f.camera_name == name), key=_order)
        ranked += [(n, place, frame) for n, frame in enumerate(own)]
    return tuple(frame for _, _, frame in sorted(ranked, key=lambda entry: entry[:2]))


def _write_flow(export: Export, folder: Path, train: tuple[PosedFrame, ...], pinholes: Pinholes) -> None:
    """Flow files of all training pictures but each camera's first; none where any is missing."""
    seen: set[str] = set()
    for number, frame in enumerate(train):
        flow = pinholes.flow(frame) if frame.camera_name in seen else None
        if flow is None and frame.camera_name in seen:
            shutil.rmtree(folder / "train_flow", ignore_errors=True)
            export.notes.append("the run has no flow, so there is no train_flow")
            return
        seen.add(frame.camera_name)
        if flow is not None:
            write_flow_file(folder / "train_flow" / flow_name(number), flow)
        export.progress((number + 1) / len(train), f"{number + 1} of {len(train)} flow files")


def moving_folder(folder: Path, notes: list[str]) -> Path:
    """`dynamic_<n>views`; with several, the one with the most cameras."""
    found = {
        int(m[1]): p
        for p in folder.glob("dynamic_*views")
        if (m := re.fullmatch(r"dynamic_(\d+)views", p.name))
    }
    if not found or not (folder / "static").is_dir():
        wrong = f"data set {folder}: expected the folders static/ and dynamic_4views/ (format devrf)"
        raise CaptureError("folder-missing", f"{wrong}; check dataset.path and dataset.format")
    chosen = found[max(found)]
    if len(found) > 1:
        others = ", ".join(p.name for p in found.values() if p != chosen)
        notes.append(f"{chosen.name} is used, not {others}")
    return chosen


def _order(frame: PosedFrame) -> tuple[str, float]:
    return frame.camera_name, frame.time or 0.0
