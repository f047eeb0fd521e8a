"""Every data set that is written is read back: same cameras, times and splits, and right for plain readers too."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from plyfile import PlyData
from tests.refused import refused

from devrf.capture.camera import Camera, undistort
from devrf.capture.errors import CaptureError, InputError
from devrf.capture.formats import DATASET_FORMATS, read_dataset, write_dataset
from devrf.capture.formats.export import MARKER, new_folder
from devrf.capture.formats.flow_files import read_flow_file
from devrf.capture.picture_files import read_pixels
from devrf.capture.scene import PosedFrame, Scene, SparsePoints

LARGEST_MISS_PX = 0.2
SEEDED = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 3))
AT_REST = ("blender", "llff", "colmap")


def expected_pixels(original: Camera, again: Camera, points: np.ndarray) -> np.ndarray:
    """Where points show in the written picture: as in the original, its lens replaced by the one read back."""
    x = (original.project(points) - original.K[:2, 2]) @ np.linalg.inv(original.K[:2, :2]).T
    ideal = undistort(x, original.distortion, original.model)
    if np.any(again.distortion):
        assert again.model == original.model
        np.testing.assert_allclose(again.distortion, original.distortion)
        return original.project(points)
    return ideal @ again.K[:2, :2].T + again.K[:2, 2]


def key(frame: PosedFrame) -> tuple:
    return (frame.camera_name, frame.index)


def check_frames(ours: tuple[PosedFrame, ...], theirs: tuple[PosedFrame, ...], numbered: bool) -> None:
    assert len(ours) == len(theirs)
    pairs = zip(
        *((sorted(ours, key=key), sorted(theirs, key=key)) if numbered else (ours, theirs)), strict=True
    )
    for a, b in pairs:
        miss = b.camera.project(SEEDED) - expected_pixels(a.camera, b.camera, SEEDED)
        assert np.linalg.norm(miss, axis=1).max() < LARGEST_MISS_PX, a
        assert (b.time, b.time_s, b.split) == (a.time, a.time_s, a.split)
        assert b.camera_name == a.camera_name


@pytest.mark.parametrize("name", DATASET_FORMATS)
@pytest.mark.parametrize("background", ["shell", "white"])
def test_round_trip(odd_scene: Scene, tmp_path: Path, name, background):
    scene = replace(odd_scene, background=background)
    notes = write_dataset(name, scene, tmp_path / "out")
    again = read_dataset(name, tmp_path / "out")
    check_frames(scene.static, again.static, name not in ("llff", "colmap"))
    check_frames(() if name in AT_REST else scene.dynamic, again.dynamic, True)
    text = (tmp_path / "out" / "README.txt").read_text()
    assert "Axes:" in text and "metres" in text
    # lenses, principal points off the middle and different focal lengths are said where a format cannot hold them
    undistorted = any("undistorted" in note for note in notes)
    assert undistorted == (name not in ("nerfstudio", "colmap"))
    if name in AT_REST:
        assert any("15 pictures" in note for note in notes)
        assert (tmp_path / "out" / "motion").is_dir() == (name == "colmap")
    if name in ("devrf", "nerfstudio", "blender"):  # box, times and background come back too
        assert (again.background, again.metric, again.near, again.t1_s) == (background, True, 2.0, 5.0)
        np.testing.assert_array_equal(again.box_from_world, scene.box_from_world)
    if name == "colmap":
        assert again.points is not None and scene.points is not None
        np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
        assert len(again.points.obs_point) == len(scene.points.obs_point)


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


@pytest.mark.parametrize("name", DATASET_FORMATS)
def test_fisheyes_come_back_or_are_undistorted(odd_scene: Scene, tmp_path: Path, name):
    scene = with_fisheyes(odd_scene)
    write_dataset(name, scene, tmp_path / "out")
    again = read_dataset(name, tmp_path / "out")
    check_frames(scene.static, again.static, name not in ("llff", "colmap"))
    kept = name in ("nerfstudio", "colmap")
    assert {f.camera.model for f in again.frames} == {"OPENCV_FISHEYE" if kept else "OPENCV"}


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


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("background", ["shell", "white"])
def test_written_pictures_show_what_their_cameras_say(odd_scene: Scene, tmp_path: Path, background, fisheye):
    """Spots drawn through the distorted lens are where the pinhole camera expects them."""
    odd_scene = with_fisheyes(odd_scene) if fisheye else odd_scene
    spots = np.array([[0.0, 0.0, 0.0], [0.55, 0.3, 0.1], [-0.5, -0.35, 0.2], [0.45, -0.4, -0.1]])
    for frame in odd_scene.frames:
        camera = frame.camera
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        picture = np.zeros((camera.height, camera.width))
        for u, v in camera.project(spots):
            picture += 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.5**2))
        cv2.imwrite(str(frame.path), picture.clip(0, 255).astype(np.uint8))
    write_dataset("devrf", replace(odd_scene, background=background), tmp_path / "out")
    for frame in read_dataset("devrf", tmp_path / "out").frames:
        rgba = read_pixels(frame.path)
        assert rgba.shape[:2] == (frame.camera.height, frame.camera.width)
        assert (rgba[..., 3] == 255).all() == (background == "shell")  # cut to what all see, or nothing cut
        for u, v in frame.camera.project(spots):
            column, row = int(u), int(v)
            patch = rgba[row - 4 : row + 5, column - 4 : column + 5, 0].astype(float)
            y, x = np.mgrid[: patch.shape[0], : patch.shape[1]] + 0.5
            found = np.array([(patch * x).sum(), (patch * y).sum()]) / patch.sum()
            miss = found + [column - 4, row - 4] - [u, v]
            assert np.abs(miss).max() < LARGEST_MISS_PX


@pytest.mark.parametrize("name", ["devrf", "blender"])
def test_plain_readers_are_right(odd_scene: Scene, tmp_path: Path, name):
    """A reader that knows `camera_angle_x` alone sees the same cameras; all pictures have one size and alpha."""
    write_dataset(name, odd_scene, tmp_path / "out")
    folder = tmp_path / "out" / ("static" if name == "devrf" else "")
    meta = json.loads((folder / "transforms_train.json").read_text())
    entry = meta["frames"][0]
    rgba = cv2.imread(str(folder / (entry["file_path"] + ".png")), cv2.IMREAD_UNCHANGED)
    assert rgba is not None
    height, width = rgba.shape[:2]
    assert rgba.shape[2] == 4
    assert 0.5 * width / np.tan(0.5 * meta["camera_angle_x"]) == pytest.approx(entry["fl_x"])
    assert (entry["fl_y"], entry["cx"], entry["cy"]) == (entry["fl_x"], width / 2, height / 2)
    assert {(e["w"], e["h"]) for e in meta["frames"]} == {(width, height)}
    assert (folder / "transforms_val.json").is_file() and "time" not in entry


def test_devrf_entries_are_in_order_of_time(odd_scene: Scene, tmp_path: Path):
    write_dataset("devrf", odd_scene, tmp_path / "out")
    meta = json.loads((tmp_path / "out/dynamic_2views/transforms_train.json").read_text())
    assert [e["camera"] for e in meta["frames"]] == ["cam0", "cam1"] * 5
    assert [e["frame_index"] for e in meta["frames"]] == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]


def test_devrf_flow_is_numbered_and_undistorted(odd_scene: Scene, tmp_path: Path):
    """Flow of a turning camera's world, known at every pixel, comes back through the pinhole camera."""
    turn = cv2.Rodrigues(np.array([0.0, 0.02, 0.03]))[0]

    def moved_by(camera: Camera, pixels: np.ndarray) -> np.ndarray:
        """Where pixels go when the camera turns: exact for any lens."""
        rays = (
            camera.directions(pixels)
            @ (camera.cam_from_world[:, :3].T @ turn @ camera.cam_from_world[:, :3]).T
        )
        return camera.project(camera.centre + rays) - pixels

    def find_flow(frame: PosedFrame):
        small = frame.camera.scaled(0.5)
        rows, columns = np.mgrid[: small.height, : small.width] + 0.5
        flow = moved_by(small, np.stack([columns, rows], axis=-1)).astype(np.float32)
        return flow, np.ones(flow.shape[:2], dtype=bool)

    write_dataset("devrf", odd_scene, tmp_path / "out", find_flow)
    files = sorted(p.name for p in (tmp_path / "out/dynamic_2views/train_flow").iterdir())
    assert files == [f"{n:03d}_bwd.npz" for n in range(2, 10)]
    scene = read_dataset("devrf", tmp_path / "out")
    with_flow = [f for f in scene.dynamic if f.flow is not None]
    assert len(with_flow) == 8 and {f.split for f in with_flow} == {"train"}
    for frame in with_flow:
        assert frame.flow is not None
        flow, mask = read_flow_file(frame.flow)
        rows, columns = np.mgrid[: frame.camera.height, : frame.camera.width] + 0.5
        truth = moved_by(frame.camera, np.stack([columns, rows], axis=-1))
        assert mask.mean() > 0.9
        inner = (slice(4, -4), slice(4, -4))  # at the border a look-up at half size repeats its last pixel
        assert np.abs(flow - truth)[inner][mask[inner]].max() < 0.1
    assert all(f.flow is None for f in read_dataset("devrf", tmp_path / "out", frame_stride=2).dynamic)


@pytest.mark.parametrize("name", ["nerfstudio", "colmap"])
def test_pictures_are_copied_where_the_format_knows_lenses(odd_scene: Scene, tmp_path: Path, name):
    write_dataset(name, odd_scene, tmp_path / "out")
    again = read_dataset(name, tmp_path / "out")
    for ours, theirs in zip(odd_scene.static, again.static, strict=True):
        assert theirs.path.read_bytes() == ours.path.read_bytes()


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
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "notes.txt").write_text("mine")
    with refused("folder-exists", tmp_path / "own", kind=InputError):
        write_dataset("colmap", odd_scene, tmp_path / "own")
    assert (tmp_path / "own" / "notes.txt").read_text() == "mine"
    (tmp_path / "own").rename(tmp_path / ".new-own")
    with refused("folder-exists", tmp_path / ".new-own", kind=InputError):
        write_dataset("colmap", odd_scene, tmp_path / "own")
    (tmp_path / ".new-own").rename(tmp_path / "own")
    (tmp_path / "own" / MARKER).write_bytes(b"\xff\xfe\x00")
    with refused("folder-exists", tmp_path / "own", kind=InputError):
        write_dataset("colmap", odd_scene, tmp_path / "own")


def test_a_failed_export_leaves_nothing(odd_scene: Scene, tmp_path: Path):
    odd_scene.static[3].path.unlink()
    for name in DATASET_FORMATS:
        with refused("picture-missing", "static_3.png", kind=CaptureError):
            write_dataset(name, odd_scene, tmp_path / "out")
        assert sorted(p.name for p in tmp_path.iterdir()) == ["pictures"]


def test_formats_at_rest_need_a_sweep(odd_scene: Scene, tmp_path: Path):
    for name in ("colmap", "llff", "blender", "devrf"):
        with refused("rest-missing", name, kind=CaptureError):
            write_dataset(name, replace(odd_scene, static=(), points=None), tmp_path / "out")


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
