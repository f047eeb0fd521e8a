"""Pictures that a data set names twice, or under two names: each counts once, and none is tested on and trained on."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.make.datasets import write_set

from devrf.capture.formats import read_dataset
from devrf.capture.formats.colmap.colmap_model import Model, read_model, write_model
from devrf.capture.formats.parts.assembly import Pictures
from devrf.capture.formats.parts.each_once import each_once
from devrf.capture.scene import Scene
from devrf.capture.system.doubles import doubles


def edit(file: Path, change: Callable[[dict[str, Any]], object]) -> None:
    meta = json.loads(file.read_text())
    change(meta)
    file.write_text(json.dumps(meta))


def both(scene: Scene) -> set[bytes]:
    """Contents of pictures that are tested on and trained on."""
    train, test = (
        {f.path.read_bytes() for f in scene.frames if f.split == split} for split in ("train", "test")
    )
    assert test
    return train & test


def under_other_names(folder: Path) -> None:
    """Half of the entries at rest again, as copies, test pictures as training ones and the other way round."""

    def again(meta: dict[str, Any]) -> None:
        for entry in [e for e in meta["frames"] if e.get("time") is None][:4]:
            name = f"copy of {Path(entry['file_path']).name}"
            shutil.copyfile(folder / entry["file_path"], folder / name)
            split = {"train": "test", "test": "train"}[entry["split"]]
            meta["frames"].append({**entry, "file_path": name, "split": split})

    edit(folder / "transforms.json", again)


@pytest.mark.parametrize("layout", ["nerfstudio", "blender"])
def test_no_picture_is_tested_on_and_trained_on(odd_scene: Scene, tmp_path: Path, layout: Any) -> None:
    folder = tmp_path / "set"
    write_set(layout, odd_scene, folder)
    at_rest, notes = len(read_dataset(layout, folder).static), []
    if layout == "nerfstudio":
        under_other_names(folder)
    else:  # one list as training and as test
        shutil.copyfile(folder / "transforms_train.json", folder / "transforms_test.json")
    scene = read_dataset(layout, folder, notes=notes)
    assert not both(scene) and len(scene.static) == (at_rest if layout == "nerfstudio" else 4)
    assert any("4 test pictures" in note for note in notes)


@pytest.mark.parametrize("layout", ["llff", "colmap"])
def test_copies_of_listed_test_pictures(odd_scene: Scene, tmp_path: Path, layout: Any) -> None:
    """`test.txt` names a picture of which a copy under another name, from the same place, is trained on."""
    folder, notes = tmp_path / "set", []
    write_set(layout, odd_scene, folder)
    frames = read_dataset(layout, folder).static
    tested = [f for f in frames if f.split == "test"]
    copy = tested[0].path.with_name("zz copy.png")
    shutil.copyfile(tested[0].path, copy)
    if layout == "llff":
        rows = np.load(folder / "poses_bounds.npy")
        np.save(folder / "poses_bounds.npy", np.vstack([rows, rows[frames.index(tested[0])]]))
    else:
        place = folder / "sparse/0"
        model = read_model(place)
        (image,) = (i for i in model.images.values() if tested[0].path.name in i.name)
        images = model.images | {99: replace(image, name=image.name.replace(tested[0].path.name, copy.name))}
        write_model(place, Model(model.cameras, images, model.points))
    scene = read_dataset(layout, folder, notes=notes)
    assert not both(scene) and len(scene.static) == len(frames)
    assert [f.path.name for f in scene.static if f.split == "test"] == [f.path.name for f in tested[1:]]
    assert any(
        f"1 test pictures are trained on too, and are not tested on: {tested[0].path.name}" in n
        for n in notes
    )


def test_listed_twice(odd_scene: Scene, tmp_path: Path) -> None:
    folder, notes = tmp_path / "set", []
    write_set("nerfstudio", odd_scene, folder)
    edit(folder / "transforms.json", lambda meta: meta["frames"].extend(meta["frames"][:3]))
    assert len(read_dataset("nerfstudio", folder, notes=notes).static) == 6
    assert any("3 pictures are there twice" in note for note in notes)


def test_what_else_belongs_to_pictures_goes_with_them(odd_scene: Scene) -> None:
    """Points' sightings, bounds, and how many are never held out; one look from two places is two pictures."""
    first, *others = odd_scene.static
    static = (first, first, *others)
    points = odd_scene.points
    assert points is not None
    bounds = np.arange(14.0).reshape(7, 2)
    got = each_once(Pictures(static, points=points, bounds=bounds, keep=6), [])
    assert got.static == odd_scene.static and got.keep == 5
    assert got.bounds is not None and got.bounds[:, 0].tolist() == [0, 4, 6, 8, 10, 12]
    assert got.points is not None
    assert sorted(set(got.points.obs_frame.tolist())) == [
        0,
        1,
        2,
        3,
        4,
    ]  # none of the seventh, which had none
    for file in (others[0].path, others[1].path):
        shutil.copyfile(first.path, file)
    assert len(each_once(Pictures(odd_scene.static), []).static) == 6


def test_doubles_are_told_by_content(tmp_path: Path) -> None:
    for name, content in (
        ("a", b"xy"),
        ("b", b"xz"),
        ("c", b"xy"),
        ("d", b"xyz"),
        ("e", b"x" * 70_000 + b"1"),
    ):
        (tmp_path / name).write_bytes(content)
    (tmp_path / "f").write_bytes(b"x" * 70_000 + b"2")
    (tmp_path / "g").symlink_to(tmp_path / "c")
    files = [tmp_path / name for name in "abcdaefgg"]
    assert doubles(files) == {2: 0, 4: 0, 7: 0, 8: 0}
