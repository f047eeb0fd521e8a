"""Finished data sets in and out: which reader or writer, what is held out, which times, and the background."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from devrf.capture.colour.photo_profile import photo_space
from devrf.capture.formats.blender import read_blender
from devrf.capture.formats.colmap.colmap_scene import read_colmap, write_colmap
from devrf.capture.formats.devrf import read_devrf
from devrf.capture.formats.llff import read_llff
from devrf.capture.formats.nerfstudio import read_nerfstudio, write_nerfstudio
from devrf.capture.formats.parts.assembly import (
    Pictures,
    box_around,
    check_sizes,
    every_nth_time,
    faces_forward,
    frustum_box,
    hold_out,
    is_plain,
)
from devrf.capture.formats.parts.each_once import each_once
from devrf.capture.formats.parts.export import Export, write_export
from devrf.capture.formats.parts.files import read_header
from devrf.capture.formats.parts.scene_files import with_scene_entry
from devrf.capture.photos.picture_files import open_picture
from devrf.capture.scene import Background, Scene
from devrf.capture.system.errors import CaptureError
from devrf.capture.system.progress import Progress, no_progress

DatasetFormat = Literal["devrf", "blender", "nerfstudio", "llff", "colmap"]
READERS: dict[DatasetFormat, Callable[[Path, list[str]], Pictures]] = {
    "devrf": read_devrf,
    "blender": read_blender,
    "nerfstudio": read_nerfstudio,
    "llff": read_llff,
    "colmap": read_colmap,
}

WRITERS: dict[str, Callable[[Export], None]] = {"nerfstudio": write_nerfstudio, "colmap": write_colmap}


def write_dataset(
    dataset_format: str,
    scene: Scene,
    folder: Path,
    progress: Progress = no_progress,
    notes: Sequence[str] = (),
) -> list[str]:
    """Write a calibrated scene as a data set, with a README.txt that states axes and scale.

    Args:
        dataset_format: One of `WRITERS`.
        scene: The scene.
        folder: New, empty, or an earlier export of the same format, which is replaced.
        progress: To be called with (fraction done, short text).
        notes: What is known of the scene already that people should know.
    Returns:
        What people should know of this data set, in words; its README.txt says the same.
    Raises:
        InputError: The folder holds something else.
        CaptureError: The format cannot hold this scene, or a picture is missing.
    """
    writer = WRITERS[dataset_format]
    return write_export(scene, dataset_format, writer, folder, progress, notes)


def guess_formats(folder: Path) -> list[DatasetFormat]:
    """Which data sets a folder may be, by the names of its files, the likeliest first."""
    signs: dict[DatasetFormat, tuple[str, ...]] = {
        "devrf": ("dynamic_*views",),
        "nerfstudio": ("transforms.json",),
        "blender": ("transforms_train.json",),
        "llff": ("poses_bounds.npy",),
        "colmap": ("sparse", "cameras.bin", "cameras.txt"),
    }
    return [name for name, marks in signs.items() if any(any(folder.glob(m)) for m in marks)]


def read_dataset(
    dataset_format: DatasetFormat,
    folder: Path,
    frame_stride: int = 1,
    holdout_every: int = 8,
    background: Background | None = None,
    notes: list[str] | None = None,
) -> Scene:
    """Read a finished data set.

    Args:
        dataset_format: `devrf` (the published layouts), `blender`, `nerfstudio`, `llff`, `colmap`.
        folder: The data set.
        frame_stride: Every n-th time is used, of test views too.
        holdout_every: Every n-th picture of the scene at rest is held out where the set names no test split.
        background: What is behind the subject; None: white behind pictures with alpha (the published data
            sets are composited so), else the surroundings, or what an export of ours says.
        notes: What was repaired or left out is added here, in words.
    Raises:
        CaptureError: The folder is not such a data set, one of its files cannot be used, or it shows
            nothing at rest.
    """
    if not folder.is_dir():
        raise CaptureError("folder-missing", f"data set {folder}: no such folder; check dataset.path")
    notes = [] if notes is None else notes
    found = each_once(READERS[dataset_format](folder, notes), notes)
    notes += _spaces(found)
    inside = folder.resolve()
    outside = [f.path for f in (*found.static, *found.dynamic) if inside not in f.path.resolve().parents]
    if outside:
        count = len(found.static) + len(found.dynamic)
        notes.append(
            f"{len(outside)} of {count} pictures lie outside of {folder}, the first is {outside[0]}: exports copy them"
        )
    check_sizes(found.dynamic)
    if frame_stride > 1 and any(f.flow is not None for f in found.dynamic):
        notes.append(
            f"the flow that the data set brings spans one step, dataset.frame_stride is {frame_stride}: not used"
        )
    static = found.static
    found = replace(
        found,
        static=static if found.has_split else hold_out(static, holdout_every, found.keep, notes),
        dynamic=every_nth_time(found.dynamic, frame_stride),
    )
    try:
        return _scene(found, background, notes)
    except (
        ValueError,
        ArithmeticError,
        np.linalg.LinAlgError,
    ) as error:  # positions of 1e300, all at one place
        text = f"data set {folder}: its cameras make no scene ({error}); look at their positions and focal lengths"
        raise CaptureError("scene-cameras-unusable", text) from None


def _spaces(found: Pictures) -> list[str]:
    """Which colour profiles the pictures have, beside sRGB, in words."""
    names: Counter[str] = Counter()
    for path in dict.fromkeys(frame.path for frame in (*found.static, *found.dynamic)):
        with open_picture(path) as image:
            space = photo_space(image)
        if space is not None:
            done = "is not read, they are taken as sRGB" if space.light is None else "is brought to sRGB"
            names[f"{space.name}, which {done}"] += 1
    return [f"{count} pictures have the colour profile {name}" for name, count in names.items()]


def _scene(found: Pictures, background: Background | None, notes: list[str]) -> Scene:
    forward = found.bounds is not None and faces_forward([f.camera for f in found.static])
    if found.bounds is not None and not forward:
        notes.append("the cameras do not look the same way: not taken as a forward-facing scene")
    behind = background
    if behind is None:
        alpha = read_header(found.static[0].path).alpha
        behind = "white" if alpha else found.behind if forward else "shell"
        if not is_plain(behind) and found.own is None and any(f.matte is not None for f in found.static):
            notes.append(
                "mask_path is not used: it may name what to leave out, or the subject; where it is the subject set "
                "dataset.background to white"
            )
    scene = (frustum_box if forward and is_plain(behind) else box_around)(found, behind)
    if found.own is None:
        return scene
    own = with_scene_entry(scene, *found.own)
    if background is None:
        return own
    fits = own.ndc is None or is_plain(background)  # surroundings need a box, not LLFF's frame
    return replace(own if fits else scene, background=background)
