"""Data sets in Blender's layout: `transforms_{train,test}.json` with one focal length, pictures named without ending.

Entries may carry their own `fl_x, fl_y, cx, cy, w, h`, `camera`, `frame_index` and `time_s`; they come before
`camera_angle_x`. The order of entries means nothing but the number of a flow file.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.formats.parts.assembly import Pictures, time_within
from devrf.capture.formats.parts.files import (
    Header,
    find_picture,
    frames_of,
    read_header,
    read_json,
    safe_name,
)
from devrf.capture.formats.parts.opengl import camera_of
from devrf.capture.formats.parts.scene_files import OWN_KEY
from devrf.capture.formats.parts.transforms import index_of
from devrf.capture.scene import PosedFrame, Split
from devrf.capture.system.amounts import some
from devrf.capture.system.errors import CaptureError

SAME_POSE_DECIMALS = 6  # of a matrix: one fixed camera's entries may be rounded differently


def read_blender(folder: Path, notes: list[str]) -> Pictures:
    """A scene at rest: `transforms_train.json` and, where it is there, `transforms_test.json`."""
    train = read_split(folder, "train", notes)
    has_test = (folder / "transforms_test.json").is_file()
    test = read_split(folder, "test", notes) if has_test else ()
    moments = {f.time for f in train}
    if len(moments) == 1 and (later := [f.path.name for f in test if f.time not in moments]):
        notes.append(
            f"{len(later)} test pictures have another time than all others, and are not used: {some(later)}"
        )
        test = tuple(f for f in test if f.time in moments)
    frames = train + test
    if len(moments) > 1:
        wrong = f"data set {folder}: every picture is of the scene in motion"
        raise CaptureError("rest-missing", f"{wrong}; a sweep of it at rest is needed")
    return Pictures(at_rest(frames), has_split=bool(test), own=own_entry(folder / "transforms_train.json"))


def at_rest(frames: tuple[PosedFrame, ...]) -> tuple[PosedFrame, ...]:
    """Pictures of the sweep: no time, numbered in order where they have no numbers of their own."""
    own = len({f.index for f in frames}) == len(frames) and all(f.camera_name == "static" for f in frames)
    return tuple(
        replace(f, time=None, time_s=None, camera_name="static", index=f.index if own else i)
        for i, f in enumerate(frames)
    )


def own_entry(path: Path) -> tuple[Any, Path] | None:
    """What an export of ours says of the scene, and in which file."""
    entry = read_json(path).get(OWN_KEY)
    return None if entry is None else (entry, path)


def read_split(folder: Path, split: Split, notes: list[str], moving: bool = False) -> tuple[PosedFrame, ...]:
    """One split, in the order of the file.

    Training pictures of one pose are one camera (view1, view2, ...). So are test pictures where poses come
    back; else they are numbered per time (test1, test2, ...).

    Args:
        folder: Where `transforms_<split>.json` lies.
        split: `train` or `test`.
        notes: What was repaired is added here, in words.
        moving: Whether every entry needs a time.
    Raises:
        CaptureError: The file or one of its entries cannot be used.
    """
    path = folder / f"transforms_{split}.json"
    meta = read_json(path)
    entries = frames_of(meta, path)
    common = {key: value for key, value in meta.items() if key not in ("frames", OWN_KEY)}
    wheres = [f"{path}: frames[{n}] ({e['file_path']})" for n, e in enumerate(entries)]
    times = [_time(e, where, moving) for e, where in zip(entries, wheres, strict=True)]
    headers = [read_header(find_picture(folder, e["file_path"])) for e in entries]
    _check_one_size(meta, entries, headers)
    grey = sum(header.grey for header in headers)
    if grey:
        notes.append(f"{path.parent.name}/{path.name}: {grey} grey pictures, read as RGB")
    cameras = [
        camera_of({**common, **e}, header, where)
        for e, header, where in zip(entries, headers, wheres, strict=True)
    ]
    names = _camera_names(entries, times, split)
    grid = {time: n for n, time in enumerate(sorted({t for t in times if t is not None}))}
    frames = []
    for n, (entry, time, where) in enumerate(zip(entries, times, wheres, strict=True)):
        time_s = entry.get("time_s")
        frames.append(
            PosedFrame(
                path=headers[n].path,
                camera=cameras[n],
                camera_name=names[n],
                index=index_of(entry, n if time is None else grid[time], where),
                time_s=float(time_s) if isinstance(time_s, int | float) else time,
                time=time,
                split=split,
            )
        )
    return tuple(frames)


def _camera_names(entries: list[dict[str, Any]], times: list[float | None], split: Split) -> list[str]:
    keys = [
        str(e["camera"])
        if "camera" in e
        else np.array(e["transform_matrix"], dtype=np.float64).round(SAME_POSE_DECIMALS).tobytes()
        for e in entries
    ]
    if all("camera" in e for e in entries):
        return [safe_name(key) for key in keys]
    stem, met, at_time = {"train": "view", "test": "test"}[split], {}, Counter()
    poses_come_back = split == "train" or min(Counter(keys).values()) > 1
    names = []
    for key, time in zip(keys, times, strict=True):
        at_time[time] += 1
        number = met.setdefault(key, len(met) + 1) if poses_come_back else at_time[time]
        names.append(f"{stem}{number}")
    return names


def _time(entry: dict[str, Any], where: str, moving: bool) -> float | None:
    if entry.get("time") is None:
        if moving:
            text = f"{where}: no time; expected a number in [0, 1] for every picture in motion"
            raise CaptureError("entry-missing", text)
        return None
    return time_within(entry["time"], where)


def _check_one_size(meta: dict[str, Any], entries: list[dict[str, Any]], headers: list[Header]) -> None:
    """One `camera_angle_x` for all is one focal length in pixels only where all pictures have one size."""
    if "fl_x" in meta:
        return
    shared = [header for header, entry in zip(headers, entries, strict=True) if "fl_x" not in entry]
    for header in shared:
        if (header.width, header.height) != (shared[0].width, shared[0].height):
            wrong = f"{header.path}: picture is {header.size}, {shared[0].path.name} is {shared[0].size}"
            shares = "both share one camera_angle_x; expected one size, or fl_x, fl_y, cx, cy per entry"
            raise CaptureError("picture-size-wrong", f"{wrong}, and {shares}")
