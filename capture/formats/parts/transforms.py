"""nerfstudio's transforms.json with the keys that we add: `camera`, `frame_index`, `time_s`, `split`, `flow_path`.

A picture's look is `colour_matrix`, `colour_gains` and `flat_field_path`.
"""

from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.colour.correction import EVEN, SAME, Look, as_gains, as_matrix
from devrf.capture.formats.parts.files import (
    find_picture,
    frames_of,
    number_or_none,
    read_header,
    read_json,
    relative_to,
    safe_name,
    write_json,
)
from devrf.capture.formats.parts.listed import pictures_of_list
from devrf.capture.formats.parts.opengl import DISTORTION_KEYS, camera_of, intrinsics_entry, opengl_pose
from devrf.capture.scene import PosedFrame, Split
from devrf.capture.system.errors import CaptureError


def write_transforms(path: Path, frames: tuple[PosedFrame, ...]) -> None:
    """Write a transforms.json with intrinsics per frame, and `time`, `camera` and `split`."""
    base = path.parent.resolve()
    write_json(path, {"frames": [frame_entry(frame, base) for frame in frames]})


def frame_entry(frame: PosedFrame, base: Path) -> dict[str, Any]:
    """One entry of `frames`; paths are relative to `base`."""
    camera = frame.camera
    keys = DISTORTION_KEYS[camera.model]
    entry = {
        "file_path": relative_to(frame.path, base),
        "transform_matrix": opengl_pose(camera),
        "camera_model": camera.model,
        **intrinsics_entry(camera),
        **{key: float(value) for key, value in zip(keys, camera.distortion[: len(keys)], strict=True)},
        "camera": frame.camera_name,
        "frame_index": frame.index,
        "time_s": frame.time_s,
        "time": frame.time,
        "split": frame.split,
    }
    if frame.look is not None:
        entry |= {"colour_matrix": frame.look.matrix, "colour_gains": frame.look.gains}
    beside = {"flow_path": frame.flow, "mask_path": frame.matte}
    return {**entry, **{key: relative_to(path, base) for key, path in beside.items() if path is not None}}


def read_transforms(path: Path, notes: list[str] | None = None) -> tuple[PosedFrame, ...]:
    """Read a transforms.json: ours or another program's, with intrinsics for all or per frame.

    Args:
        path: The file.
        notes: What was repaired is added here, in words.
    Raises:
        CaptureError: Not such a file, or an entry that cannot be used.
    """
    meta = read_json(path)
    common = {key: value for key, value in meta.items() if key != "frames"}
    frames, grey = [], 0
    entries = frames_of(meta, path)
    test = test_pictures(meta, entries, path, [] if notes is None else notes)
    for number, entry in enumerate(entries):
        where = f"{path}: frames[{number}] ({entry['file_path']})"
        header = read_header(find_picture(path.parent, entry["file_path"]))
        grey += header.grey
        time = number_or_none(entry, "time", where)
        time_s = number_or_none(entry, "time_s", where)
        frames.append(
            PosedFrame(
                path=header.path,
                camera=camera_of({**common, **entry}, header, where),
                camera_name=safe_name(entry.get("camera", "static" if time is None else "camera")),
                index=index_of(entry, number, where),
                time_s=time if time_s is None else time_s,
                time=time,
                split=split_of(entry, number in test, where),
                flow=None if entry.get("flow_path") is None else (path.parent / entry["flow_path"]).resolve(),
                look=_look(entry, where),
                matte=None
                if entry.get("mask_path") is None
                else find_picture(path.parent, str(entry["mask_path"])),
            )
        )
    if grey and notes is not None:
        notes.append(f"{path.name}: {grey} grey pictures, read as RGB")
    return tuple(frames)


def index_of(entry: dict[str, Any], number: int, where: str) -> int:
    """`frame_index` of an entry, else the number given."""
    index = entry.get("frame_index", number)
    if isinstance(index, bool) or not isinstance(index, int) or index < 0:
        text = f"{where}: frame_index is {index!r}; expected a whole number from 0"
        raise CaptureError("entry-wrong", text)
    return index


def _look(entry: dict[str, Any], where: str) -> Look | None:
    """The look of an entry; None where it names none."""
    matrix, gains = (entry.get(k) for k in ("colour_matrix", "colour_gains"))
    if matrix is None and gains is None:
        return None
    try:
        return Look(
            SAME if matrix is None else as_matrix(np.array(matrix, np.float64).reshape(3, 3)),
            EVEN if gains is None else as_gains(np.array(gains, np.float64).reshape(3)),
        )
    except (TypeError, ValueError) as error:
        wrong = f"{where}: its colour correction cannot be used ({error})"
        expected = (
            "colour_matrix with 3 rows of 3 numbers and colour_gains with 3 numbers above 0, or no such keys"
        )
        raise CaptureError("entry-wrong", f"{wrong}; expected {expected}") from None


def test_pictures(
    meta: dict[str, Any], entries: list[dict[str, Any]], path: Path, notes: list[str]
) -> set[int]:
    """Entries that nerfstudio's lists of names mean for testing; how many names mean none is added to `notes`.

    Raises:
        CaptureError: A list that is none.
    """
    names: list[str] = []
    for key in ("test_filenames", "val_filenames"):
        listed = meta.get(key) or []
        if not isinstance(listed, list):
            text = f"{path}: {key} is {listed!r}; expected a list of names"
            raise CaptureError("entry-wrong", text)
        names += map(str, listed)
    return pictures_of_list(names, [e["file_path"] for e in entries], "test_filenames, val_filenames", notes)


def split_of(entry: dict[str, Any], listed: bool, where: str) -> Split:
    """`split` of the entry, else whether it is `listed` for testing (`test_pictures`).

    Raises:
        CaptureError: A split that is none.
    """
    split = entry.get("split")
    if split is None:
        return "test" if listed else "train"
    if split not in ("train", "test", "val"):
        raise CaptureError("entry-wrong", f"{where}: split is {split!r}; expected train or test")
    return "train" if split == "train" else "test"
