"""nerfstudio's layout: one `transforms.json`; pictures without `time` are at rest, those with it in motion.

Without a training picture in motion there is no motion to learn: the set is one at rest.

`time` may be in seconds: outside [0, 1] all times are rescaled. Moving pictures of one pose are one camera.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from devrf.capture.camera import LensModel
from devrf.capture.formats.geometry.ply import write_ply
from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.formats.parts.export import Export, copied
from devrf.capture.formats.parts.files import frames_of, read_json, with_slashes, write_json
from devrf.capture.formats.parts.point_colours import point_colours
from devrf.capture.formats.parts.scene_files import OWN_KEY, scene_entry
from devrf.capture.formats.parts.transforms import frame_entry, read_transforms, split_of, test_pictures
from devrf.capture.scene import PosedFrame
from devrf.capture.system.errors import CaptureError

POINTS = "sparse_pc.ply"  # as nerfstudio's own converter names it
PLY_HEADER_BYTES = 4096  # the count of points is in its first lines
SAME_POSE_DECIMALS = 6  # fixed cameras' entries may be rounded differently


def read_nerfstudio(folder: Path, notes: list[str]) -> Pictures:
    """A scene at rest, and in motion where pictures have times."""
    path = folder / "transforms.json"
    frames = read_transforms(path, notes)
    static = tuple(f for f in frames if f.time is None)
    dynamic = tuple(f for f in frames if f.time is not None)
    if _is_one_moment([f.time for f in frames]):
        notes.append(f"every picture has the time {frames[0].time:g}: taken as a scene at rest")
        static, dynamic = tuple(replace(f, time=None, time_s=None) for f in frames), ()
    if not static:
        wrong = f"data set {folder}: no picture without a time, so none of the scene at rest"
        raise CaptureError("rest-missing", f"{wrong}; add a sweep of it")
    if dynamic and all(f.split == "test" for f in dynamic):
        notes.append(
            f"{len(dynamic)} test pictures have a time, no training picture has one: they are not used"
        )
        dynamic = ()
    meta = read_json(path)
    own = meta.get(OWN_KEY)
    if own is None and (count := _points_beside(folder, meta.get("ply_file_path"))):
        notes.append(
            f"{count} points of ply_file_path are not used, the box is a loose cube: they name no pictures"
        )
    return Pictures(
        static,
        _within_0_1(_cameras(dynamic, notes), notes),
        has_split=any(f.split == "test" for f in static),
        own=None if own is None else (own, path),
    )


def _is_one_moment(times: Sequence[object]) -> bool:
    """Whether a set gives all its pictures one and the same time, as converters do that know of no scene at rest."""
    return times[0] is not None and all(time == times[0] for time in times)


def _points_beside(folder: Path, name: object) -> int | None:
    """How many points a PLY file has by its header; None where none is named or there."""
    file = folder / with_slashes(str(name))
    if name is None or not file.is_file():
        return None
    with file.open("rb") as opened:
        found = re.search(rb"element vertex (\d{1,18})\b", opened.read(PLY_HEADER_BYTES))
    return int(found[1]) if found else None


def is_at_rest(folder: Path) -> bool:
    """Whether no training picture has a time, without a look at pictures. False where the file cannot be read."""
    path = folder / "transforms.json"
    try:
        meta = read_json(path)
        entries = frames_of(meta, path)
        if _is_one_moment([entry.get("time") for entry in entries]):
            return True
        test = test_pictures(meta, entries, path, [])
        moving = [(n in test, entry) for n, entry in enumerate(entries) if entry.get("time") is not None]
        return all(split_of(entry, listed, str(path)) == "test" for listed, entry in moving)
    except CaptureError:
        return False  # who reads it says why


def write_nerfstudio(export: Export) -> None:
    """`transforms.json` with each camera's own lens, the pictures as they are, and the sparse points."""
    scene = export.scene
    base = export.folder.resolve()
    frames = copied(export, scene.frames, "images")
    entries = [frame_entry(frame, base) for frame in frames]
    cloud = {}
    if scene.points is not None:
        rgb = point_colours(scene.points, frames[: len(scene.static)]) / 255
        comments = ["sparse points of the scene at rest, in the world of transforms.json"]
        write_ply(export.folder / POINTS, scene.points.xyz, None, rgb, comments=comments)
        cloud = {"ply_file_path": POINTS}
    write_json(
        export.folder / "transforms.json",
        {
            "camera_model": _common_lens(frames, export.notes),
            **{
                f"{split}_filenames": [
                    e["file_path"] for e, f in zip(entries, frames, strict=True) if f.split == used
                ]
                for split, used in (("train", "train"), ("val", "test"), ("test", "test"))
            },
            **cloud,
            OWN_KEY: scene_entry(scene),
            "frames": [{key: value for key, value in e.items() if value is not None} for e in entries],
        },
    )


def _common_lens(frames: tuple[PosedFrame, ...], notes: list[str]) -> LensModel:
    """The lens model of most pictures, which nerfstudio takes for all: it asks the top of the file alone."""
    counts: Counter[LensModel] = Counter(f.camera.model for f in frames)
    (model, most), *others = counts.most_common()
    for other, count in others:
        notes.append(
            f"{count} of the {len(frames)} pictures have the lens {other}, {most} have {model}, which is at the top of "
            "transforms.json: nerfstudio takes it for all pictures, so leave out the entries of the others "
            "there (their camera_model names them), or export to colmap"
        )
    return model


def _cameras(frames: tuple[PosedFrame, ...], notes: list[str]) -> tuple[PosedFrame, ...]:
    """Moving pictures without a camera's name get one by their pose, where poses come back."""
    nameless = [f for f in frames if f.camera_name == "camera"]
    poses = [f.camera.cam_from_world.round(SAME_POSE_DECIMALS).tobytes() for f in nameless]
    if len(set(poses)) < 2 or min(Counter(poses).values()) < 2:
        return frames
    names = {pose: f"view{n + 1}" for n, pose in enumerate(dict.fromkeys(poses))}
    taken = {f.camera_name for f in frames}
    if taken & set(names.values()):
        return frames
    notes.append(f"moving pictures without a camera's name: {len(names)} cameras by their poses")
    of = {id(f): names[pose] for f, pose in zip(nameless, poses, strict=True)}
    numbers: Counter[str] = Counter()
    out = []
    for frame in sorted(frames, key=lambda f: f.time or 0.0):
        name = of.get(id(frame))
        if name is None:
            out.append(frame)
        else:
            out.append(replace(frame, camera_name=name, index=numbers[name]))
            numbers[name] += 1
    return tuple(out)


def _within_0_1(frames: tuple[PosedFrame, ...], notes: list[str]) -> tuple[PosedFrame, ...]:
    """Times as they are within [0, 1], else mapped from first and last."""
    times = np.array([f.time for f in frames], dtype=np.float64)
    if len(times) == 0 or (times.min() >= 0 and times.max() <= 1):
        return frames
    first, last = float(times.min()), float(times.max())
    if last <= first:
        text = f"every moving picture has the time {first}; expected more than one time"
        raise CaptureError("times-equal", text)
    notes.append(f"times from {first:g} to {last:g} are taken as seconds and rescaled to [0, 1]")
    return tuple(
        replace(f, time=(t - first) / (last - first)) for f, t in zip(frames, times.tolist(), strict=True)
    )
