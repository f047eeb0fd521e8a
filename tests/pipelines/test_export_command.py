"""Data sets through the command line: exported, run again from the export, and refused where they are wrong."""

import json
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from tests.make.datasets import LAYOUTS, write_set
from tests.refused import refused

from devrf.calibration.formats import RIG_WRITERS
from devrf.calibration.rigs.given import read_given
from devrf.calibration.rigs.rig import Rig, read_rig
from devrf.capture.formats import WRITERS, read_dataset, write_dataset, write_scene
from devrf.capture.formats.parts.export import MARKER, README
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.scene import Scene
from devrf.pipelines.config.gone import GONE
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.terminal.console import Talk


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
    early = devrf("export", scene_yaml, "--format", "nerfstudio")
    assert early.code == 2 and "--until scene" in early.err and "[stage-not-made]" in early.err
    assert devrf("run", scene_yaml, "--until", "flow", "--allow-unhealthy").code == 0
    for name in WRITERS:
        result = devrf("export", scene_yaml, "--format", name)
        assert result.code == 0, result.said
        assert str(folder / "run/export" / name) in result.out
    out = folder / "run/export/nerfstudio"
    again = devrf("run", written(folder, "nerfstudio", out, "again"), "--until", "flow", "--allow-unhealthy")
    assert again.code == 0, again.said
    twice = devrf("export", scene_yaml, "--format", "colmap", "--out", out)
    assert twice.code == 2 and f"--out {out}: " in twice.err and "[folder-exists]" in twice.err


def test_flow_that_a_data_set_brings(devrf: Callable, odd_scene: Scene, tmp_path: Path) -> None:
    write_set("devrf", odd_scene, tmp_path / "data")
    scene, until = (
        written(tmp_path, "devrf", tmp_path / "data", "run"),
        ("--until", "flow", "--allow-unhealthy"),
    )
    for stride, method in ((1, "given"), (2, "dis")):
        result = devrf("run", scene, *until, "--set", f"dataset.frame_stride={stride}")
        assert result.code == 0, result.said
        assert json.loads((tmp_path / "run/flow/flow.json").read_text())["method"] == method
        rows = json.loads((tmp_path / "run/scene/health.json").read_text())["rows"]
        assert any("dataset.frame_stride is 2" in str(row["value"]) for row in rows) == (stride == 2)


def test_a_data_set_has_the_times_that_were_trained_with(odd_scene: Scene, tmp_path: Path) -> None:
    for name in ("scene", "deformation"):
        (tmp_path / "run" / name).mkdir(parents=True)
    write_scene(tmp_path / "run" / "scene", odd_scene)
    for name in ("scene", "deformation"):
        (tmp_path / "run" / name / "stamp.json").touch()
    (tmp_path / "run" / "deformation" / "metrics.json").write_text('{"clock_offsets_s": {"cam0": -0.3}}')
    folder = export(Talk("normal"), tmp_path / "run", ExportOptions("nerfstudio"))

    def times_s(scene: Scene, name: str) -> list[float]:
        return [f.time_s for f in scene.dynamic if f.camera_name == name and f.time_s is not None]

    written = read_dataset("nerfstudio", folder)
    # The first of its five pictures was taken before anything is modelled.
    assert times_s(written, "cam0") == pytest.approx([t - 0.3 for t in times_s(odd_scene, "cam0")[1:]])
    for name in ("cam1", "witness"):
        assert times_s(written, name) == pytest.approx(times_s(odd_scene, name))


def test_an_export_is_not_written_through_a_link(devrf: Callable, tmp_path: Path) -> None:
    """A run folder that came from elsewhere: only a folder that --out names may lie outside."""
    scene, outside = written(tmp_path, "nerfstudio", tmp_path, "run"), tmp_path / "outside"
    outside.mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "export").symlink_to(outside)
    result = devrf("export", scene, "--format", "nerfstudio")
    assert result.code == 2 and f"{outside}" in result.err and "[folder-holds-link]" in result.err, (
        result.said
    )
    named = devrf("export", scene, "--format", "nerfstudio", "--out", tmp_path / "named")
    assert "[stage-not-made]" in named.err, named.said


def test_an_unknown_format(devrf: Callable, scene_yaml: Path) -> None:
    result = devrf("export", scene_yaml, "--format", "nerfstudo")
    assert result.code == 2 and "nerfstudio?" in result.err and "[option-unknown-value]" in result.err


@pytest.mark.parametrize("name", ["blender", "devrf", "llff", "mesh", "npz", "rig-anipose", "zarr"])
def test_a_format_that_is_gone(devrf: Callable, scene_yaml: Path, name: str) -> None:
    result = devrf("export", scene_yaml, "--format", name)
    assert result.code == 2 and f"--format {name}: {GONE[f'--format {name}']}" in " ".join(result.err.split())


@pytest.mark.parametrize(
    ("name", "file", "text", "refusal"),
    [
        ("nerfstudio", "transforms.json", "{", "file-damaged"),
        ("devrf", "dynamic_2views/transforms_train.json", '{"frames": []}', "pictures-none"),
        ("devrf", "dynamic_2views/train_flow/003_bwd.npz", "x", "file-damaged"),
        ("colmap", "sparse/0/images.bin", "x", "file-damaged"),
        ("llff", "poses_bounds.npy", "x", "file-damaged"),
        ("blender", "transforms_train.json", "[]", "file-damaged"),
    ],
)
def test_a_damaged_data_set_is_seen_before_anything_starts(
    devrf: Callable, odd_scene: Scene, tmp_path: Path, name, file: str, text: str, refusal: str
) -> None:
    write_set(name, odd_scene, tmp_path / "data")
    (tmp_path / "data" / file).write_text(text)
    result = devrf("run", written(tmp_path, name, tmp_path / "data", "run"))
    assert result.code == 2, result.said
    with refused(refusal, Path(file).name) as why:
        read_dataset(name, tmp_path / "data")
    assert f"{why.value}" in result.err and "[inputs-unusable]" in result.err
    assert not (tmp_path / "run" / "scene").exists()


def test_a_picture_that_ends_early_is_seen_before_anything_starts(
    devrf: Callable, odd_scene: Scene, tmp_path: Path
) -> None:
    write_dataset("nerfstudio", odd_scene, tmp_path / "data")
    picture = next((tmp_path / "data" / "images" / "witness").iterdir())  # a test picture, read last of all
    picture.write_bytes(picture.read_bytes()[:-200])
    scene = written(tmp_path, "nerfstudio", tmp_path / "data", "run")
    with refused("picture-unreadable", picture) as why:
        read_pixels(picture)
    for choice in ((), ("--dry-run",)):
        result = devrf("run", scene, *choice)
        assert result.code == 2, result.said
        assert f"{why.value}" in result.err and "[inputs-unusable]" in result.err
    assert not (tmp_path / "run").exists()


def test_a_data_set_without_scene_yaml_says_who_writes_one(
    devrf: Callable, odd_scene: Scene, tmp_path: Path
) -> None:
    for name in LAYOUTS:
        write_set(name, odd_scene, tmp_path / name)
        result = devrf("status", tmp_path / name)
        assert result.code == 2 and f"devrf-pipeline init {tmp_path / name}" in result.err
    nowhere = tmp_path / "nowhere" / "scene.yaml"
    said = devrf("status", nowhere).err
    assert f"{nowhere}: " in said and "[configuration]" in said


def test_the_rig_is_written_for_other_programs(devrf: Callable, data_dir: Path, tmp_path: Path) -> None:
    """Webcams calibrated by caliscope: named in scene.yaml, used, and written for others."""
    source = data_dir / "caliscope_post_optimization"
    clips = {f"cam{n}": str(source / f"calibration/extrinsic/cam_{n}.mp4") for n in range(4)}
    value = {
        "name": "webcams",
        "output": "run",
        "preset": "tiny",
        "capture": {"cameras": clips, "range_s": [0, 0.4]},
        "calibration": {"rig": {"given": str(source / "camera_array.toml")}, "sync": {"method": "none"}},
    }
    scene = tmp_path / "scene.yaml"
    scene.write_text(yaml.safe_dump(value))
    early = devrf("export", scene, "--format", "rig-opencv")
    assert early.code == 2 and "--until rig" in early.err and "[stage-not-made]" in early.err
    result = devrf("run", scene, "--until", "rig", "--verbose")
    assert result.code == 0, result.said
    assert "caliscope" in result.said and "cam0: 0" in result.said
    assert devrf("export", scene, "--format", "rig-opencv").code == 0
    rig = read_rig(tmp_path / "run/rig/rig.json")
    for name in RIG_WRITERS:
        folder = export(Talk("quiet"), tmp_path / "run", ExportOptions(name))
        files = [path for path in folder.iterdir() if path.name not in (MARKER, README)]
        found = files[0] if len(files) == 1 and files[0].is_file() else folder
        given = read_given(found, list(clips), dict.fromkeys(clips, (1280, 720)), "m")
        assert given.rig is not None, name
        for again, camera in zip(from_first(given.rig), from_first(rig), strict=True):
            np.testing.assert_allclose(again, camera, atol=1e-9, err_msg=name)
    wrong = devrf("export", scene, "--format", "rig-openc")
    assert wrong.code == 2 and "rig-opencv?" in wrong.err and "[option-unknown-value]" in wrong.err
    assert "metres" in (tmp_path / "run/export/rig-opencv/README.txt").read_text()


def from_first(rig: Rig) -> list[np.ndarray]:
    """Poses in the frame of the first camera: some formats have no other world."""
    poses = [np.vstack([c.camera.cam_from_world, [0, 0, 0, 1]]) for c in rig.cameras.values()]
    return [pose @ np.linalg.inv(poses[0]) for pose in poses]


def test_a_calibration_for_other_cameras_is_told_before_anything_starts(
    devrf: Callable, data_dir: Path, tmp_path: Path
) -> None:
    source = data_dir / "opencv_stereo_chessboard"
    clips = {f"cam{n}": str(data_dir / f"pose2sim_single/videos/cam0{n}.mp4") for n in (1, 3)}

    def check(given: object) -> str:
        value = {"name": "x", "capture": {"cameras": clips}, "calibration": {"rig": {"given": given}}}
        (tmp_path / "scene.yaml").write_text(yaml.safe_dump(value))
        result = devrf("run", tmp_path / "scene.yaml", "--until", "flow", "--dry-run")
        assert result.code == 2
        return " ".join(result.err.split())

    assert "cam1, cam3; it has left_intrinsics" in check(str(source / "left_intrinsics.yml"))
    single = str(source / "left_intrinsics.yml")
    assert re.search("640x480.* 1080x1920", check({"cam1": single, "cam3": single}))
    assert "'nothing.yml': " in check({"cam1": "nothing.yml", "cam3": single})
    qualisys = data_dir / "pose2sim_single/calibration/Calib.qca.txt"
    said = check(str(qualisys))
    assert re.search("Calib.qca.txt: .*'cam1' .* 1088x1920.* 1080x1920", said)
    file = cv2.FileStorage(str(tmp_path / "lens.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.array([[1600.0, 0, 540], [0, 1600, 960], [0, 0, 1]]))
    file.write("distortion_coefficients", np.zeros((1, 5)))
    file.release()
    lens = str(tmp_path / "lens.yml")
    assert "calibration.rig.given: holds intrinsics only" in check({"cam1": lens, "cam3": lens})
