"""Every data set that is written is read back: same cameras, times and splits, and right for plain readers too."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData
from tests.make.datasets import write_set
from tests.refused import refused

from devrf.capture.formats import WRITERS, read_dataset, write_dataset
from devrf.capture.formats.parts.export import MARKER, new_folder
from devrf.capture.scene import PosedFrame, Scene, SparsePoints
from devrf.capture.system.errors import CaptureError, InputError

LARGEST_MISS_PX = 1e-6
SEEDED = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))


def key(frame: PosedFrame) -> tuple:
    return (frame.camera_name, frame.index)


def check_frames(ours: tuple[PosedFrame, ...], theirs: tuple[PosedFrame, ...], numbered: bool) -> None:
    assert len(ours) == len(theirs)
    pairs = zip(
        *((sorted(ours, key=key), sorted(theirs, key=key)) if numbered else (ours, theirs)), strict=True
    )
    for a, b in pairs:
        assert b.camera.model == a.camera.model
        miss = b.camera.project(SEEDED) - a.camera.project(SEEDED)
        assert np.linalg.norm(miss, axis=1).max() < LARGEST_MISS_PX, a
        assert (b.time, b.time_s, b.split) == (a.time, a.time_s, a.split)
        assert b.camera_name == a.camera_name


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize(("background", "fisheye"), [("shell", False), ("white", False), ("shell", True)])
def test_round_trip(odd_scene: Scene, tmp_path: Path, name, background, fisheye):
    scene = replace(with_fisheyes(odd_scene) if fisheye else odd_scene, background=background)
    notes = write_dataset(name, scene, tmp_path / "out")
    again = read_dataset(name, tmp_path / "out")
    check_frames(scene.static, again.static, name == "nerfstudio")
    check_frames(scene.dynamic if name == "nerfstudio" else (), again.dynamic, True)
    for ours, theirs in zip(scene.static, again.static, strict=True):
        assert theirs.path.read_bytes() == ours.path.read_bytes()
    text = (tmp_path / "out" / "README.txt").read_text()
    assert "Axes:" in text and "metres" in text
    if name == "nerfstudio":  # box, times and background come back too
        assert (again.background, again.metric, again.near, again.t1_s) == (background, True, 2.0, 5.0)
        np.testing.assert_array_equal(again.box_from_world, scene.box_from_world)
    else:
        assert any("15 pictures" in note for note in notes) and (tmp_path / "out" / "motion").is_dir()
    if name == "colmap" and scene.points is not None:
        assert again.points is not None
        np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
        assert len(again.points.obs_point) == len(scene.points.obs_point)


@pytest.mark.parametrize("name", ["devrf", "blender"])
def test_entries_may_bring_lens_camera_and_time(odd_scene: Scene, tmp_path: Path, name):
    write_set(name, odd_scene, tmp_path)
    again = read_dataset(name, tmp_path)
    check_frames(odd_scene.static, again.static, True)
    check_frames(odd_scene.dynamic if name == "devrf" else (), again.dynamic, True)


def test_sparse_points_have_the_colours_of_their_pictures(odd_scene: Scene, tmp_path: Path) -> None:
    """Each picture is of one colour: a point has the mean of those in which it lies, grey where it is in none."""
    assert odd_scene.points is not None
    points, static = odd_scene.points, odd_scene.static
    xyz = np.vstack([points.xyz, 2 * static[0].camera.centre - points.xyz[0]])  # one behind the first camera
    kept = (points.obs_point + points.obs_frame) % 3 > 0
    seen_by = np.append(points.obs_point[kept], len(points.xyz)), np.append(points.obs_frame[kept], 0)
    points = SparsePoints(xyz, *seen_by)
    scene = replace(odd_scene, points=points)
    for n, frame in enumerate(static):
        picture = np.full((frame.camera.height, frame.camera.width, 3), (n, 2 * n, 200 - n), np.uint8)
        cv2.imwrite(str(frame.path), picture[..., ::-1])
    expected = np.full((len(xyz), 3), 128.0)
    for k in range(len(xyz) - 1):
        seen = [
            (n, 2 * n, 200 - n)
            for n in points.obs_frame[points.obs_point == k].tolist()
            if np.all((at := static[n].camera.project(points.xyz[k])) >= 0)
            and np.all(at < (static[n].camera.width, static[n].camera.height))
        ]
        expected[k] = np.mean(seen, axis=0) if seen else 128
    assert len(np.unique(expected, axis=0)) > 2
    write_dataset("nerfstudio", scene, tmp_path / "nerfstudio")
    named = json.loads((tmp_path / "nerfstudio/transforms.json").read_text())["ply_file_path"]
    vertex = PlyData.read(str(tmp_path / "nerfstudio" / named))["vertex"]
    np.testing.assert_allclose(np.stack([vertex[a] for a in "xyz"], 1), xyz, rtol=1e-6)
    rgb = np.stack([vertex[c] for c in ("red", "green", "blue")], 1)
    np.testing.assert_allclose(rgb, expected, atol=0.51)
    write_dataset("colmap", scene, tmp_path / "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "colmap/sparse/0"))
    np.testing.assert_array_equal([model.points3D[k + 1].color for k in range(len(xyz))], rgb)


def with_fisheyes(scene: Scene) -> Scene:
    """The scene as fisheye lenses of the same focal lengths would have seen it."""

    def seen(frame: PosedFrame) -> PosedFrame:
        lens = np.array([-0.02, 0.01, -0.003, 0.001, 0.0])
        return replace(frame, camera=replace(frame.camera, distortion=lens, model="OPENCV_FISHEYE"))

    return replace(
        scene, static=tuple(map(seen, scene.static)), dynamic=tuple(map(seen, scene.dynamic)), points=None
    )


def test_nerfstudio_is_told_the_lens_at_the_top_where_it_looks(odd_scene: Scene, tmp_path: Path):
    wide = with_fisheyes(odd_scene)
    notes = write_dataset("nerfstudio", wide, tmp_path / "wide")
    assert json.loads((tmp_path / "wide/transforms.json").read_text())["camera_model"] == "OPENCV_FISHEYE"
    assert not any("OPENCV_FISHEYE" in note for note in notes)
    few = replace(odd_scene, static=wide.static[:1] + odd_scene.static[1:])
    write_dataset("nerfstudio", few, tmp_path / "few")
    assert json.loads((tmp_path / "few/transforms.json").read_text())["camera_model"] == "OPENCV"
    assert f"1 of the {len(few.frames)} pictures" in (tmp_path / "few/README.txt").read_text()
    models = [f.camera.model for f in read_dataset("nerfstudio", tmp_path / "few").static]
    assert models == ["OPENCV_FISHEYE", *["OPENCV"] * (len(models) - 1)]  # ours asks each entry


def test_an_export_replaces_only_an_export_of_the_same_format(odd_scene: Scene, tmp_path: Path):
    out = tmp_path / "out"
    write_dataset("colmap", odd_scene, out)
    (out / "README.txt").write_text("changed")
    write_dataset("colmap", odd_scene, out)
    assert (out / "README.txt").read_text() != "changed"
    for name in ("outputs/trained.ckpt", "motion/notes.txt", "empty/"):
        path = out / name
        path.mkdir() if name.endswith("/") else (path.parent.mkdir(exist_ok=True), path.write_text("mine"))
        with refused("folder-exists", out, name.strip("/"), kind=InputError):
            write_dataset("colmap", odd_scene, out)
        path.rmdir() if name.endswith("/") else path.unlink()
    (out / "outputs").rmdir()
    with refused("folder-exists", "colmap", kind=InputError):
        write_dataset("nerfstudio", odd_scene, out)
    own, new = tmp_path / "own", tmp_path / ".new-own"
    own.mkdir()
    (own / "notes.txt").write_text("mine")
    for there in (own, new, own):  # something else; in the way of what is made; with a mark that is none
        if there is not own:
            own.rename(new)
        elif new.exists():
            new.rename(own)
            (own / MARKER).write_bytes(b"\xff\xfe\x00")
        with refused("folder-exists", there, kind=InputError):
            write_dataset("colmap", odd_scene, own)
        assert (there / "notes.txt").read_text() == "mine"


def test_a_failed_export_leaves_nothing(odd_scene: Scene, tmp_path: Path):
    odd_scene.static[3].path.unlink()
    for name in WRITERS:
        with refused("picture-missing", "static_3.png", kind=CaptureError):
            write_dataset(name, odd_scene, tmp_path / "out")
        assert sorted(p.name for p in tmp_path.iterdir()) == ["pictures"]


def test_a_format_at_rest_needs_a_sweep(odd_scene: Scene, tmp_path: Path):
    with refused("rest-missing", "colmap", kind=CaptureError):
        write_dataset("colmap", replace(odd_scene, static=(), points=None), tmp_path / "out")


def test_two_exports_into_one_folder_at_once(tmp_path: Path) -> None:
    """The second is refused and harms nothing; what a killed one left is cleared away."""
    with new_folder(tmp_path / "out", "ply") as new:
        (new / "a.ply").write_text("a")
        with refused("folder-busy", tmp_path / "out", kind=InputError), new_folder(tmp_path / "out", "ply"):
            pass
        assert (new / "a.ply").is_file()
    (tmp_path / ".new-out").mkdir()
    (tmp_path / ".new-out" / MARKER).write_text("ply\n")
    with new_folder(tmp_path / "out", "ply") as new:
        (new / "b.ply").write_text("b")
    assert sorted(path.name for path in tmp_path.rglob("*")) == [MARKER, "b.ply", "out"]


def test_pictures_outside_of_a_data_set_are_named(odd_scene: Scene, tmp_path: Path) -> None:
    write_dataset("nerfstudio", odd_scene, tmp_path / "set")
    notes: list[str] = []
    read_dataset("nerfstudio", tmp_path / "set", notes=notes)
    before = len(notes)
    picture = next((tmp_path / "set").rglob("*.png"))
    picture.rename(tmp_path / "elsewhere.png")
    picture.symlink_to(tmp_path / "elsewhere.png")
    notes.clear()
    read_dataset("nerfstudio", tmp_path / "set", notes=notes)
    assert len(notes) == before + 1
    assert any(text.startswith("1 of ") and "elsewhere" in text for text in notes)
