"""The model taken elsewhere: a ball that moves, whose place, size and colour are known, opened by other programs."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import typer
import yaml
from scipy.spatial.transform import Rotation, Slerp
from tests.make.glb import read_glb
from tests.make.models import COLOUR, KEYS, RADIUS, TRAVEL, moving_ball, rigid_ball
from tests.refused import refused

from devrf.capture.formats import write_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import InputError, ReconstructError
from devrf.pipelines.cli.main import app
from devrf.pipelines.export.export_command import export
from devrf.pipelines.export.formats import FORMATS
from devrf.pipelines.export.request import ExportOptions
from devrf.pipelines.terminal.console import Talk
from devrf.reconstruct.storage.model_io import FILE, save_deformation, save_motion, save_rest
from devrf.reconstruct.tracking.rigid import motion_of

UNIT = 1 / 1.25  # of the world in the box frame, as odd_scene has it
R = RADIUS * UNIT
MODEL = ("ply", "glb")


@pytest.fixture
def run_dir(odd_scene: Scene, tmp_path: Path) -> Path:
    """A run as far as `deformation`, made by hand."""
    run, model = tmp_path / "run", moving_ball()
    write_scene(run / "scene", replace(odd_scene, background="white"))
    for stage in ("canonical", "deformation"):
        (run / stage).mkdir()
    save_rest(run / "canonical" / FILE, model.rest)
    assert model.motion is not None
    save_motion(run / "deformation" / FILE, model.motion, model.rest.canonical.voxel)
    for stage in ("scene", "canonical", "deformation"):
        (run / stage / "stamp.json").write_text("{}")
    return run


def exported(run: Path, name: str, **options) -> tuple[Path, dict]:
    folder = export(Talk("quiet"), run, ExportOptions(name, **options))
    return folder, json.loads((folder / "export.json").read_text()) if name in MODEL else {}


def centre_at(time_s: float) -> np.ndarray:
    return np.array([TRAVEL * UNIT * (time_s - 2.0) / 3.0, 0, 0])


def test_point_clouds_open_in_plyfile_and_trimesh(run_dir: Path) -> None:
    plyfile, trimesh = pytest.importorskip("plyfile"), pytest.importorskip("trimesh")
    folder, facts = exported(run_dir, "ply", times="2s,3.5s")
    assert [entry["time_s"] for entry in facts["files"]] == [2.0, 3.5] and facts["metric"]
    for entry in facts["files"]:
        cloud = trimesh.load(folder / entry["file"])
        away = cloud.vertices - centre_at(entry["time_s"])
        assert len(away) > 50
        assert np.abs(np.linalg.norm(away, axis=1) - R).max() < 0.1 * R
        np.testing.assert_allclose(cloud.colors[:, :3].mean(0) / 255, COLOUR, atol=0.03)
        np.testing.assert_allclose([entry["min"], entry["max"]], cloud.bounds, atol=1e-6)
        data = plyfile.PlyData.read(folder / entry["file"])
        assert "unit: metres" in data.comments and f"at {entry['time_s']:.4f} s" in data.comments
        normals = np.stack([data["vertex"][axis] for axis in ("nx", "ny", "nz")], axis=1)
        assert np.median((normals * away).sum(1) / np.linalg.norm(away, axis=1)) > 0.9
    readme = " ".join((folder / "README.txt").read_text().split())
    assert "Axes: " in readme and " metres" in readme
    up = np.mean([-f for f in np.array([[0.05, 1.0, 0.0]])], axis=0)  # how odd_scene's cameras are held
    assert np.dot(facts["up"], up) / np.linalg.norm(up) > 0.99


def test_one_animated_mesh(run_dir: Path) -> None:
    pytest.importorskip("skimage")
    trimesh = pytest.importorskip("trimesh")
    folder, facts = exported(run_dir, "glb")
    path = folder / "scene.glb"
    mesh, turn = read_glb(path), np.array(facts["gltf_from_world"])
    assert mesh.times_s == pytest.approx([0.0, 1.5, 3.0]) and facts["first_time_s"] == 2.0
    assert len(mesh.shapes) == KEYS
    for time_s, shape in zip(facts["key_times_s"], mesh.shapes, strict=True):
        np.testing.assert_allclose(shape.mean(0), centre_at(time_s) + mesh.vertices.mean(0), atol=2e-3)
        np.testing.assert_allclose(shape.max(0) - shape.min(0), 2 * R, rtol=0.06)
    np.testing.assert_allclose(turn @ facts["up"], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(mesh.turn, turn, atol=1e-6)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    scene = trimesh.load(path)  # shows it at rest, with y up
    (thing,) = scene.geometry.values()
    assert thing.is_watertight and thing.volume == pytest.approx(4 / 3 * np.pi * R**3, rel=0.08)
    np.testing.assert_allclose(scene.bounds, [[-R] * 3, [R] * 3], atol=0.1 * R)
    np.testing.assert_allclose(mesh.rgb.mean(0), COLOUR, atol=0.05)
    assert max(facts["forward_motion"]["median"]) < facts["forward_motion"]["voxel"]


@pytest.mark.parametrize("times", [None, "2s,3.5s"])
def test_rigid_parts_are_nodes_that_move_as_the_model_does(run_dir: Path, times: str | None) -> None:
    pytest.importorskip("skimage")
    trimesh = pytest.importorskip("trimesh")
    save_deformation(run_dir / "deformation", rigid_ball())
    folder, facts = exported(run_dir, "glb", times=times)
    mesh = read_glb(folder / "scene.glb")
    assert mesh.names == ["part 1"] and facts["parts"] == 1
    assert any("without what stands" in note for note in facts["notes"])
    assert mesh.times_s == pytest.approx(np.linspace(0, 3, 5) if times is None else [0, 1.5])
    assert facts["first_time_s"] == 2.0
    assert max(facts["forward_motion"]["median"]) < facts["forward_motion"]["voxel"]
    for time_s, shape in zip(mesh.times_s, mesh.shapes, strict=True):
        turn = Rotation.from_rotvec([0, 0, np.pi / 2 * time_s / 3]).as_matrix()
        np.testing.assert_allclose(shape, mesh.vertices @ turn.T + centre_at(2.0 + time_s), atol=2e-3)
    scene = trimesh.load(folder / "scene.glb")
    (thing,) = scene.geometry.values()
    assert thing.is_watertight and thing.volume == pytest.approx(4 / 3 * np.pi * R**3, rel=0.08)
    np.testing.assert_allclose(scene.bounds, [[-R] * 3, [R] * 3], atol=0.1 * R)
    np.testing.assert_allclose(mesh.rgb.mean(0), COLOUR, atol=0.05)


def test_soft_parts_stretch_on_their_nodes(run_dir: Path) -> None:
    pytest.importorskip("skimage")
    model = rigid_ball()
    assert model.movers is not None
    rng = np.random.default_rng(0)
    skewed = 0.1 * rng.normal(size=(len(model.movers.times), 1, 3, 3))
    stretches = np.eye(3) + np.cumsum(skewed + skewed.swapaxes(2, 3), axis=0)
    model.movers.stretches = torch.from_numpy(stretches).float()
    save_deformation(run_dir / "deformation", model)
    folder, facts = exported(run_dir, "glb")
    mesh = read_glb(folder / "scene.glb")
    assert max(facts["forward_motion"]["median"]) < facts["forward_motion"]["voxel"]
    middle, away = model.movers.middles()[0] * UNIT, mesh.vertices - model.movers.middles()[0] * UNIT
    turns = model.movers.rotations[:, 0].double().numpy()
    for turn, stretch, shift, shape in zip(
        turns, stretches[:, 0], model.movers.shifts[:, 0].double().numpy(), mesh.shapes, strict=True
    ):
        place = turn @ stretch @ middle + shift * UNIT
        np.testing.assert_allclose(shape, away @ (turn @ stretch).T + place, atol=2e-3)


def test_nodes_go_between_moments_as_the_model_does(run_dir: Path) -> None:
    """By the specification: rotations along the arc, places along the line."""
    pytest.importorskip("skimage")
    model = rigid_ball()
    assert model.movers is not None
    model.movers.rotations[1, 0] = torch.from_numpy(Rotation.from_rotvec([1.0, 0.4, 0.2]).as_matrix()).float()
    model.movers.shifts[1, 0] = torch.tensor([0.1, -0.2, 0.3])
    save_deformation(run_dir / "deformation", model)
    keys = read_glb(exported(run_dir, "glb")[0] / "scene.glb")
    turns, shifts = motion_of(keys.vertices, np.stack(keys.shapes[:2]))
    middle = model.movers.middles()[0] * UNIT
    turn = Slerp([0, 1], Rotation.from_matrix(turns))(0.3).as_matrix()
    place = np.array([0.7, 0.3]) @ (turns @ middle + shifts)
    shutil.rmtree(run_dir / "export")
    between = read_glb(exported(run_dir, "glb", times=f"{2 + 0.3 * 0.75}s")[0] / "scene.glb")
    expected = (keys.vertices - middle) @ turn.T + place
    np.testing.assert_allclose(between.shapes[0], expected, atol=2e-4)


def test_a_glb_is_as_the_specification_has_it(run_dir: Path) -> None:
    """What validators look at: chunks of whole words, accessors in their views, bounds, a weight per target and key."""
    pytest.importorskip("skimage")
    folder, _ = exported(run_dir, "glb", times="2")
    data = (folder / "scene.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    value = json.loads(data[20 : 20 + length])
    assert data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") == len(data) and length % 4 == 0
    size = {5126: 4, 5123: 2, 5125: 4}
    for accessor in value["accessors"]:
        view = value["bufferViews"][accessor["bufferView"]]
        columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["count"] * columns * size[accessor["componentType"]] == view["byteLength"]
        assert view["byteOffset"] % 4 == 0
    assert value["buffers"][0]["byteLength"] == len(data) - 28 - length
    (primitive,) = value["meshes"][0]["primitives"]
    places = [primitive["attributes"]["POSITION"], *(t["POSITION"] for t in primitive["targets"])]
    assert all({"min", "max"} <= value["accessors"][n].keys() for n in places)
    assert len({value["accessors"][n]["count"] for n in places}) == 1
    (animation,) = value["animations"]
    (sampler,) = animation["samplers"]
    keys, weights = (value["accessors"][sampler[part]] for part in ("input", "output"))
    assert weights["count"] == keys["count"] * len(primitive["targets"]) and keys["min"] == [0.0]


def test_a_scene_in_which_nothing_moves(odd_scene: Scene, run_dir: Path) -> None:
    pytest.importorskip("skimage")
    for path in (run_dir / "deformation").iterdir():
        path.unlink()
    _, facts = exported(run_dir, "ply")
    assert [entry["time_s"] for entry in facts["files"]] == [None]
    assert len(facts["notes"]) == 1 and "motion" in facts["notes"][0]
    shutil.rmtree(run_dir / "scene" / "dynamic")
    write_scene(run_dir / "scene", replace(odd_scene, background="white", dynamic=(), rest_time=None))
    folder, facts = exported(run_dir, "glb")
    assert not facts["notes"] and read_glb(folder / "scene.glb").shapes == []
    with refused("option-misplaced", "--times 3", kind=InputError):
        exported(run_dir, "ply", times="3")


@pytest.mark.parametrize(
    ("name", "options", "refusal", "named"),
    [
        ("ply", {"times": "9s"}, "option-out-of-range", ("--times 9s", "0 to 1", "2.000s to 5.000s")),
        ("ply", {"times": "soon"}, "option-malformed", ("--times soon",)),
        ("ply", {"times": "0"}, "option-out-of-range", ("--times 0: ", " 1 to ")),
        ("ply", {"level": 0.5}, "option-misplaced", ("--level: ", "--format ply", "glb")),
        ("nerfstudio", {"times": "3"}, "option-misplaced", ("--times: ", "--format nerfstudio")),
        ("glb", {"level": 1.5}, "option-out-of-range", ("--level 1.5: ", "0 and 1")),
        ("glb", {"device": "tpu"}, "option-unknown-value", ("--device tpu: ", "cuda")),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_written(
    run_dir: Path, name, options, refusal, named
) -> None:
    with refused(refusal, *named, kind=InputError):
        exported(run_dir, name, **options)
    assert not (run_dir / "export").exists()


def test_an_extra_that_is_missing(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage", None)
    with refused("package-missing", " skimage,", "pip install 'devrf[export]'", kind=InputError):
        exported(run_dir, "glb")
    exported(run_dir, "ply", times="1")  # needs nothing


def test_a_run_that_is_not_finished_or_not_healthy(run_dir: Path) -> None:
    row = {
        "code": "x",
        "check": "sweep registered",
        "value": 0.1,
        "unit": "",
        "warn": 0.9,
        "fail": 0.5,
        "verdict": "fail",
    }
    row["remedy"] = "film slower"
    (run_dir / "scene" / "health.json").write_text(json.dumps({"rows": [row]}))
    _, facts = exported(run_dir, "ply", times="1")
    assert facts["notes"][0].endswith("scene is unhealthy: sweep registered; film slower")
    (run_dir / "canonical" / "stamp.json").unlink()
    with refused("stage-not-made", "the model", "--until canonical", kind=InputError):
        exported(run_dir, "glb")


def test_nothing_solid_and_nothing_left(run_dir: Path) -> None:
    pytest.importorskip("skimage")
    model = moving_ball()
    model.rest.canonical.density.clamp_(max=-5.0 - model.rest.canonical.shift)
    save_rest(run_dir / "canonical" / FILE, model.rest)
    with refused("model-without-surface", "0.5", kind=ReconstructError):
        exported(run_dir, "glb", times="1")
    with refused("model-without-surface", "2.0000 s", kind=ReconstructError):
        exported(run_dir, "ply", times="1")
    assert list((run_dir / "export").iterdir()) == []


def test_folders_in_use(run_dir: Path, tmp_path: Path) -> None:
    folder, _ = exported(run_dir, "ply", times="1")
    (folder / "stray.txt").write_text("old")
    with refused("folder-exists", folder, "stray.txt", kind=InputError):
        exported(run_dir, "ply", times="1")
    (folder / "stray.txt").unlink()
    exported(run_dir, "ply", times="1")
    with refused("folder-exists", f"--out {folder}: ", " ply", kind=InputError):
        export(Talk("quiet"), run_dir, ExportOptions("splat", folder))
    (tmp_path / "file").write_text("")
    with refused("folder-unwritable", tmp_path / "file", kind=InputError):
        export(Talk("quiet"), run_dir, ExportOptions("splat", tmp_path / "file" / "out"))


def test_the_command(devrf: Callable, run_dir: Path) -> None:
    scene = run_dir.parent / "scene.yaml"
    data = {"format": "nerfstudio", "path": "data"}
    scene.write_text(yaml.safe_dump({"name": "ball", "output": "run", "preset": "tiny", "dataset": data}))
    result = devrf("export", scene, "--format", "ply", "--times", "2", "--device", "cpu")
    assert result.code == 0, result.said
    assert "point clouds (ply)" in result.out


def test_help_names_every_format() -> None:
    group: Any = typer.main.get_command(app)
    told = next(p.help for p in group.commands["export"].params if "--format" in p.opts)
    assert not [name for name in FORMATS if name not in told]
