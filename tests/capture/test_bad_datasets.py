"""Data sets that are wrong in one way each: the message names file, value, expectation and remedy."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from devrf.capture.errors import CaptureError
from devrf.capture.formats import read_dataset, write_dataset
from devrf.capture.picture_files import read_pixels
from devrf.capture.scene import Scene

TRAIN = "dynamic_2views/transforms_train.json"


class Folders(dict):
    """A good data set in every format, written when it is asked for."""

    def __init__(self, scene: Scene, root: Path) -> None:
        self.scene, self.root = scene, root

    def __missing__(self, name: Any) -> Path:
        self[name] = self.root / name
        write_dataset(name, self.scene, self[name], _no_motion)
        return self[name]


@pytest.fixture
def folders(odd_scene: Scene, tmp_path: Path) -> Folders:
    return Folders(odd_scene, tmp_path / "sets")


def _no_motion(frame):
    shape = (frame.camera.height, frame.camera.width)
    return np.zeros((*shape, 2), np.float32), np.ones(shape, bool)


def last_picture(folder: Path) -> Path:
    """One that is read: no test picture, none of the model in motion beside COLMAP's."""
    unread = {"test", "motion"}
    return sorted(p for p in folder.rglob("*.png") if not unread & set(p.relative_to(folder).parts))[-1]


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def pose(number: int, row: int, column: int, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda meta: meta["frames"][number]["transform_matrix"][row].__setitem__(column, value)


def mirrored(meta: dict[str, Any]) -> None:
    matrix = np.array(meta["frames"][2]["transform_matrix"])
    matrix[:3, 0] *= -1
    meta["frames"][2]["transform_matrix"] = matrix.tolist()


def entry(number: int, **values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda meta: meta["frames"][number].update(values)


TRANSFORMS = {
    "devrf": TRAIN,
    "blender": "transforms_train.json",
    "nerfstudio": "transforms.json",
}


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (pose(2, 0, 3, float("nan")), r"frames\[2\] .*not finite.*remove the picture"),
        (mirrored, r"frames\[2\] .*mirror.*determinant -1.000, expected 1.*wrong way"),
        (pose(2, 0, 0, 7.0), r"frames\[2\] .*not rigid.*expected 1, 1, 1"),
        (entry(1, transform_matrix=[[1, 2], [3, 4]]), r"frames\[1\] .*shape \[2, 2\]; expected 4 rows"),
        (entry(1, transform_matrix="no"), r"frames\[1\].transform_matrix is 'no'"),
        (entry(1, file_path="gone"), r"gone: picture not found.*copy it"),
        (entry(1, file_path=3), r"frames\[1\].file_path is 3; expected the path"),
        (entry(1, fl_x=-5.0), r"frames\[1\] .*focal length is -5.0.*above 0"),
        (entry(1, cx="left"), r"frames\[1\] .*cx is 'left'; expected a number"),
        (entry(1, w=17), r"picture is \d+x\d+, .*frames\[1\] .* says 17x"),
        (entry(1, frame_index=-1), r"frame_index is -1; expected a whole number"),
        (lambda meta: meta.update(frames=[]), "no frames listed"),
        (lambda meta: meta.update(frames={"a": 1}), "no frames listed"),
        (lambda meta: meta["frames"].__setitem__(0, 5), r"frames\[0\] is 5; expected an object"),
        (lambda meta: meta.update(devrf_scene={"near": 1}), "devrf_scene is damaged"),
    ],
)
def test_transforms(folders, name: Any, change, says):
    path = folders[name] / TRANSFORMS[name]
    edit(path, change)
    with pytest.raises(CaptureError, match=says) as raised:
        read_dataset(name, folders[name])
    assert str(folders[name]) in str(raised.value)


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize("text", ["{", "[1]", "", "\x00\xff"])
def test_no_json(folders, name: Any, text):
    path = folders[name] / TRANSFORMS[name]
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(CaptureError, match=f"{path.name}: (not a JSON file|holds a list)"):
        read_dataset(name, folders[name])


@pytest.mark.parametrize("name", ["devrf", "blender"])
@pytest.mark.parametrize(("value", "says"), [(1.5, "time is 1.5"), ("now", "'now'"), (float("nan"), "nan")])
def test_times_outside_0_1(folders, name: Any, value, says):
    edit(folders[name] / TRANSFORMS[name], entry(3, time=value))
    with pytest.raises(CaptureError, match=rf"frames\[3\] .*{says}.*in \[0, 1\]"):
        read_dataset(name, folders[name])


def test_times_that_are_missing_or_no_numbers(folders):
    edit(folders["devrf"] / TRAIN, lambda meta: meta["frames"][3].pop("time"))
    with pytest.raises(CaptureError, match=r"frames\[3\] .*no time"):
        read_dataset("devrf", folders["devrf"])
    edit(folders["nerfstudio"] / "transforms.json", entry(3, time="now"))
    with pytest.raises(CaptureError, match=r"frames\[3\] .*time is 'now'"):
        read_dataset("nerfstudio", folders["nerfstudio"])


def test_a_monocular_set_in_motion_has_no_scene_at_rest(folders):
    def give_times(meta: dict[str, Any]) -> None:
        for n, e in enumerate(meta["frames"]):
            e["time"] = n / len(meta["frames"])

    edit(folders["blender"] / "transforms_train.json", give_times)
    with pytest.raises(CaptureError, match="a sweep of it at rest is needed"):
        read_dataset("blender", folders["blender"])


@pytest.mark.parametrize("name", ["devrf", "nerfstudio", "blender", "llff", "colmap"])
@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("LA", "2 channels .grey and transparency.; expected grey, RGB or RGBA; save it"),
        ("text", "not a picture"),
        ("gone", "gone|picture not found|found images"),
        ("small", r"picture is 20x20|picture is 20x20, .*says"),
    ],
)
def test_pictures(folders, name: Any, kind, says):
    from PIL import Image

    victim = last_picture(folders[name])
    if kind == "gone":
        victim.unlink()
    elif kind == "text":
        victim.write_text("no picture")
    else:
        size = (20, 20) if kind == "small" else Image.open(victim).size
        Image.new("LA" if kind == "LA" else "RGB", size).save(victim)
    with pytest.raises(CaptureError, match=says):
        read_dataset(name, folders[name])


@pytest.mark.parametrize("name", ["devrf", "nerfstudio", "blender", "llff", "colmap"])
def test_grey_pictures_are_read_and_said(folders, name: Any):
    victim = last_picture(folders[name])
    cv2.imwrite(str(victim), np.ascontiguousarray(read_pixels(victim)[..., 0]))
    notes: list[str] = []
    read_dataset(name, folders[name], notes=notes)
    assert any("1 grey pictures, read as RGB" in note for note in notes)


def test_mixed_sizes_within_a_camera(folders):
    def smaller(meta: dict[str, Any]) -> None:
        e = next(e for e in meta["frames"] if e["camera"] == "cam1" and e["frame_index"] == 3)
        path = folders["nerfstudio"] / e["file_path"]
        cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
        e |= {"w": 30, "h": 20}

    edit(folders["nerfstudio"] / "transforms.json", smaller)
    with pytest.raises(CaptureError, match="000003.png: picture is 30x20, .* 'cam1' is 80x56"):
        read_dataset("nerfstudio", folders["nerfstudio"])


def test_one_focal_length_for_pictures_of_two_sizes(folders):
    def plain(meta: dict[str, Any]) -> None:
        for e in meta["frames"]:
            for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
                del e[key]

    path = folders["blender"] / "transforms_train.json"
    edit(path, plain)
    victim = json.loads(path.read_text())["frames"][1]["file_path"] + ".png"
    cv2.imwrite(str(folders["blender"] / victim), np.zeros((20, 30, 3), np.uint8))
    with pytest.raises(CaptureError, match="picture is 30x20.*share one camera_angle_x"):
        read_dataset("blender", folders["blender"])


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (
            lambda p: np.savez(p, flow=np.zeros((20, 30, 2)), mask=np.ones((20, 30))),
            r"flow has shape \[20, 30, 2\]",
        ),
        (lambda p: np.savez(p, flow=np.zeros((20, 30, 2))), "damaged or not a file of arrays"),
        (lambda p: p.write_text("no zip"), "damaged or not a file of arrays"),
        (lambda p: p.unlink(), "flow of .* not found, while the folder is there"),
    ],
)
def test_flow_files(folders, damage, says):
    damage(folders["devrf"] / "dynamic_2views/train_flow/005_bwd.npz")
    with pytest.raises(CaptureError, match=f"005_bwd.npz: {says}"):
        read_dataset("devrf", folders["devrf"])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t[:-1], "5 pictures in images, .*found images 6"),
        (lambda t: t[:, :15], r"shape \[6, 15\]; expected one row of 17 numbers"),
        (lambda t: np.where(np.arange(17) == 15, -1.0, t), "bounds of row 0 are .* expected 0 < near < far"),
        (lambda t: np.where(np.arange(17) == 14, 0.0, t), r"row 0 .*height, width, focal are"),
        (lambda t: np.where(np.arange(17) == 3, np.nan, t), r"row 0 .*not finite"),
        (lambda t: np.where(np.isin(np.arange(17), (1, 6, 11)), -t, t), r"row 0 .*mirror"),
        (
            lambda t: np.where(np.arange(17) == 4, 3 * t, t),
            r"000000.png: picture is .*expected the same shape",
        ),
    ],
)
def test_llff_tables(folders, change, says):
    path = folders["llff"] / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with pytest.raises(CaptureError, match=says):
        read_dataset("llff", folders["llff"])


def test_llff_files(folders):
    path = folders["llff"] / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(CaptureError, match="poses_bounds.npy: .*expected a table of numbers"):
        read_dataset("llff", folders["llff"])
    path.unlink()
    with pytest.raises(CaptureError, match="poses_bounds.npy: no such file"):
        read_dataset("llff", folders["llff"])


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("kept", [0, 5, 40, -3])
def test_colmap_files_that_were_cut_off(folders, name, kept):
    path = folders["colmap"] / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(CaptureError, match=f"{name}: damaged or cut off.*copy it again"):
        read_dataset("colmap", folders["colmap"])


def test_colmap_text_that_is_none(folders):
    folder = folders["colmap"] / "sparse/0"
    (folder / "cameras.bin").unlink()
    for text in ("1 PINHOLE 40", "1 PINHOLE 40 30 1 2 3", "1 NEW_MODEL 40 30 1 2 3", "a b c d e"):
        (folder / "cameras.txt").write_text(text)
        with pytest.raises(CaptureError, match="cameras.txt: damaged"):
            read_dataset("colmap", folders["colmap"])
    (folder / "cameras.txt").write_text("")
    with pytest.raises(CaptureError, match="its camera 1 is not in the model"):
        read_dataset("colmap", folders["colmap"])


@pytest.mark.parametrize("name", ["devrf", "nerfstudio", "blender", "llff", "colmap"])
def test_a_folder_of_another_format_and_none(tmp_path: Path, name: Any):
    with pytest.raises(CaptureError, match="dataset.format|COLMAP model"):
        read_dataset(name, tmp_path)
    with pytest.raises(CaptureError, match="no such folder"):
        read_dataset(name, tmp_path / "none")
