"""Data sets through the command line: exported, run again from the export, and refused where they are wrong."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from devrf.capture.formats import DATASET_FORMATS, read_dataset, write_dataset
from devrf.capture.scene import Scene


@pytest.fixture
def scene_yaml(odd_scene: Scene, tmp_path: Path) -> Path:
    """A small data set in nerfstudio's format, to be run."""
    write_dataset("nerfstudio", odd_scene, tmp_path / "data")
    return written(tmp_path, "nerfstudio", tmp_path / "data", "run")


def written(folder: Path, name: str, path: Path, run: str) -> Path:
    value = {"name": "odd", "output": run, "preset": "tiny", "dataset": {"format": name, "path": str(path)}}
    file = folder / f"{run}.yaml"
    file.write_text(yaml.safe_dump(value))
    return file


def test_export_and_run_from_it(devrf: Callable, scene_yaml: Path, odd_scene: Scene) -> None:
    folder = scene_yaml.parent
    early = devrf("export", scene_yaml, "--format", "devrf")
    assert early.code == 2 and "has not been made yet" in early.err and "--until scene" in early.err
    assert devrf("run", scene_yaml, "--until", "flow", "--allow-unhealthy").code == 0
    for name in DATASET_FORMATS:
        result = devrf("export", scene_yaml, "--format", name)
        assert result.code == 0, result.said
        assert str(folder / "run/export" / name) in result.out
    out = folder / "run/export/devrf"
    assert all(
        f.flow is not None for f in read_dataset("devrf", out).dynamic if f.split == "train" and f.index
    )
    again = devrf("run", written(folder, "devrf", out, "again"), "--until", "flow", "--allow-unhealthy")
    assert again.code == 0, again.said
    assert json.loads((folder / "again/flow/flow.json").read_text())["method"] == "given"
    twice = devrf("export", scene_yaml, "--format", "colmap", "--out", out)
    assert twice.code == 2 and "holds an export to devrf" in twice.err
    strided = devrf(
        "run",
        folder / "again.yaml",
        "--until",
        "flow",
        "--allow-unhealthy",
        "--set",
        "dataset.frame_stride=2",
    )
    assert strided.code == 0, strided.said
    rows = json.loads((folder / "again/scene/health.json").read_text())["rows"]
    assert any("dataset.frame_stride is 2: not used" in str(row["value"]) for row in rows)
    assert json.loads((folder / "again/flow/flow.json").read_text())["method"] == "dis"


def test_an_unknown_format(devrf: Callable, scene_yaml: Path) -> None:
    result = devrf("export", scene_yaml, "--format", "nerfstudo")
    assert result.code == 2 and "did you mean nerfstudio?" in result.err


@pytest.mark.parametrize(
    ("name", "file", "text", "says"),
    [
        ("nerfstudio", "transforms.json", "{", "not a JSON file"),
        ("devrf", "dynamic_2views/transforms_train.json", '{"frames": []}', "no frames listed"),
        ("devrf", "dynamic_2views/train_flow/003_bwd.npz", "x", "damaged or not a flow file"),
        ("colmap", "sparse/0/images.bin", "x", "damaged or cut off"),
        ("llff", "poses_bounds.npy", "x", "not a table of numbers"),
        ("blender", "transforms_train.json", "[]", "holds a list"),
    ],
)
def test_a_damaged_data_set_is_seen_before_anything_starts(
    devrf: Callable, odd_scene: Scene, tmp_path: Path, name, file: str, text: str, says: str
) -> None:
    write_dataset(name, odd_scene, tmp_path / "data", _flow_of_nothing)
    (tmp_path / "data" / file).write_text(text)
    result = devrf("run", written(tmp_path, name, tmp_path / "data", "run"))
    assert result.code == 2, result.said
    assert says in result.err and Path(file).name in result.err and "Traceback" not in result.said
    assert not (tmp_path / "run" / "scene").exists()


def test_a_picture_that_ends_early_is_seen_before_anything_starts(
    devrf: Callable, odd_scene: Scene, tmp_path: Path
) -> None:
    write_dataset("nerfstudio", odd_scene, tmp_path / "data")
    picture = next((tmp_path / "data" / "images" / "witness").iterdir())  # a test picture, read last of all
    picture.write_bytes(picture.read_bytes()[:-200])
    scene = written(tmp_path, "nerfstudio", tmp_path / "data", "run")
    for choice in ((), ("--dry-run",)):
        result = devrf("run", scene, *choice)
        assert result.code == 2, result.said
        assert str(picture) in result.err and "cannot be read" in result.err and "make it again" in result.err
    assert not (tmp_path / "run").exists()


def test_a_data_set_without_scene_yaml_says_what_to_write(
    devrf: Callable, odd_scene: Scene, tmp_path: Path
) -> None:
    for name in ("nerfstudio", "devrf", "llff", "blender", "colmap"):
        write_dataset(name, odd_scene, tmp_path / name, _flow_of_nothing)
        result = devrf("status", tmp_path / name)
        assert result.code == 2 and f"format: {name}, path: {tmp_path / name}" in result.err
    assert "no such folder" in devrf("status", tmp_path / "nowhere" / "scene.yaml").err


def _flow_of_nothing(frame):
    import numpy as np

    shape = (frame.camera.height, frame.camera.width)
    return np.zeros((*shape, 2), np.float32), np.ones(shape, bool)
