"""The published DeVRF layout with cameras around the subject: `static/` and `dynamic_<n>views/`, Blender's keys.

Each folder's files have their own `camera_angle_x`. `train_flow/NNN_bwd.npz` is the flow of entry NNN of
`transforms_train.json`, counted in the order of the file. A validation split is not read.
The forward-facing layout of the same name is in `devrf_forward.py`; what is there decides.
"""

import re
from pathlib import Path

from devrf.capture.formats.blender import at_rest, own_entry, read_split
from devrf.capture.formats.devrf_forward import read_devrf_forward
from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.formats.parts.flow_files import flow_name, with_flow_files
from devrf.capture.scene import PosedFrame
from devrf.capture.system.errors import CaptureError


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
