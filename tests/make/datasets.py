"""Data sets of a scene in every layout that is read: those that are exported by our writers, the others by hand."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from devrf.capture.formats import FLIP_YZ, WRITERS, write_dataset
from devrf.capture.scene import PosedFrame, Scene

LAYOUTS = ("devrf", "nerfstudio", "blender", "llff", "colmap")


def write_set(layout: str, scene: Scene, folder: Path) -> None:
    """Write what is needed of the scene; `devrf` has flow files, of nothing that moves."""
    if layout in WRITERS:
        write_dataset(layout, scene, folder)
    elif layout == "llff":
        _write_llff(scene, folder)
    else:
        _write_splits(scene.static, folder / ("static" if layout == "devrf" else ""))
        if layout == "devrf":
            _write_moving(scene, folder)


def _write_moving(scene: Scene, folder: Path) -> None:
    """Entries of all cameras' first pictures, then all second ones, and so on."""
    moving = sorted(scene.dynamic, key=lambda frame: frame.index)
    train = [frame for frame in moving if frame.split == "train"]
    place = folder / f"dynamic_{len({frame.camera_name for frame in train})}views"
    _write_splits(moving, place)
    (place / "train_flow").mkdir()
    for n, frame in enumerate(train):
        if frame.index:
            shape = (frame.camera.height, frame.camera.width)
            flow = np.zeros((*shape, 2), np.float32)
            np.savez(place / f"train_flow/{n:03d}_bwd.npz", flow=flow, mask=np.ones(shape, bool))


def _write_splits(frames: Sequence[PosedFrame], folder: Path) -> None:
    """`transforms_<split>.json` with each picture's own lens, and the pictures, named without their ending."""
    for split in ("train", "test"):
        entries = []
        for frame in (frame for frame in frames if frame.split == split):
            name = f"{split}/{frame.camera_name}_{frame.index:06d}"
            picture = folder / f"{name}.png"
            picture.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(frame.path, picture)
            entries.append(_entry(frame, name))
        meta = {"camera_angle_x": 0.8, "frames": entries}
        (folder / f"transforms_{split}.json").write_text(json.dumps(meta))


def _entry(frame: PosedFrame, name: str) -> dict[str, Any]:
    camera = frame.camera
    entry: dict[str, Any] = {
        "file_path": f"./{name}",
        "transform_matrix": (camera.world_from_cam @ FLIP_YZ).tolist(),
        **{"w": camera.width, "h": camera.height, "fl_x": camera.K[0, 0], "fl_y": camera.K[1, 1]},
        **{"cx": camera.K[0, 2], "cy": camera.K[1, 2]},
        **dict(zip(("k1", "k2", "p1", "p2", "k3"), camera.distortion.tolist(), strict=True)),
        **{"camera": frame.camera_name, "frame_index": frame.index},
    }
    return entry | ({} if frame.time is None else {"time": frame.time, "time_s": frame.time_s})


def _write_llff(scene: Scene, folder: Path) -> None:
    """The pictures at rest as those of lenses without distortion."""
    (folder / "images").mkdir(parents=True)
    rows = []
    for n, frame in enumerate(scene.static):
        camera, pose = frame.camera, frame.camera.world_from_cam
        shutil.copyfile(frame.path, folder / f"images/{n:06d}.png")
        hwf = [camera.height, camera.width, camera.K[0, 0]]
        matrix = np.column_stack([pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], hwf])
        rows.append([*matrix.ravel(), scene.near, scene.far])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    test = [f"{n:06d}.png\n" for n, frame in enumerate(scene.static) if frame.split == "test"]
    (folder / "test.txt").write_text("".join(test))
