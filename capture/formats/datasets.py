"""Finished data sets in: which reader, what is held out, which times, and the background."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from devrf.capture.errors import CaptureError
from devrf.capture.formats.assembly import (
    Pictures,
    box_around,
    check_sizes,
    every_nth_time,
    frustum_box,
    hold_out,
    is_plain,
)
from devrf.capture.formats.blender import read_blender
from devrf.capture.formats.colmap import read_colmap
from devrf.capture.formats.devrf import read_devrf
from devrf.capture.formats.files import read_header
from devrf.capture.formats.llff import read_llff
from devrf.capture.formats.nerfstudio import read_nerfstudio
from devrf.capture.formats.scene_files import with_scene_entry
from devrf.capture.scene import Background, Scene

DatasetFormat = Literal["devrf", "blender", "nerfstudio", "llff", "colmap"]
DATASET_FORMATS: tuple[DatasetFormat, ...] = get_args(DatasetFormat)
READERS: dict[DatasetFormat, Callable[[Path, list[str]], Pictures]] = {
    "devrf": read_devrf,
    "blender": read_blender,
    "nerfstudio": read_nerfstudio,
    "llff": read_llff,
    "colmap": read_colmap,
}


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
        raise CaptureError(f"data set {folder}: no such folder; check dataset.path")
    notes = [] if notes is None else notes
    found = READERS[dataset_format](folder, notes)
    check_sizes(found.dynamic)
    if frame_stride > 1 and any(f.flow is not None for f in found.dynamic):
        notes.append(
            f"the flow that the data set brings spans one step, dataset.frame_stride is {frame_stride}: not used"
        )
    static = found.static
    found = replace(
        found,
        static=static if found.has_split else hold_out(static, holdout_every, found.keep),
        dynamic=every_nth_time(found.dynamic, frame_stride),
    )
    return _scene(found, background)


def _scene(found: Pictures, background: Background | None) -> Scene:
    behind = background
    if behind is None:
        behind = "white" if read_header(found.static[0].path).alpha else found.behind
    scene = (
        frustum_box(found, behind)
        if found.bounds is not None and is_plain(behind)
        else box_around(found, behind)
    )
    if found.own is None:
        return scene
    scene = with_scene_entry(scene, *found.own)
    return scene if background is None else replace(scene, background=background)
