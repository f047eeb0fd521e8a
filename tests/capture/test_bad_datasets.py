"""Data sets that are wrong in one way each: the error has its code and names file and value."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.make.datasets import LAYOUTS, write_set
from tests.refused import refused

from devrf.capture.formats import read_dataset
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.scene import Scene
from devrf.capture.system.errors import CaptureError

TRAIN = "dynamic_2views/transforms_train.json"


class Folders(dict):
    """A good data set in every format, written when it is asked for."""

    def __init__(self, scene: Scene, root: Path) -> None:
        self.scene, self.root = scene, root

    def __missing__(self, name: Any) -> Path:
        self[name] = self.root / name
        write_set(name, self.scene, self[name])
        return self[name]


@pytest.fixture
def folders(odd_scene: Scene, tmp_path: Path) -> Folders:
    return Folders(odd_scene, tmp_path / "sets")


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


TRANSFORMS = {"devrf": TRAIN, "blender": "transforms_train.json", "nerfstudio": "transforms.json"}


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        (pose(2, 0, 3, float("nan")), ("pose-not-finite", "frames[2]")),
        (mirrored, ("pose-mirrored", "frames[2]", "determinant -1.000")),
        (pose(2, 0, 0, 7.0), ("pose-not-rigid", "frames[2]")),
        (entry(1, transform_matrix=[[1, 2], [3, 4]]), ("pose-wrong", "frames[1]", "[2, 2]")),
        (entry(1, transform_matrix="no"), ("entry-wrong", "frames[1].transform_matrix is 'no'")),
        (entry(1, file_path="gone"), ("picture-missing", "gone")),
        (entry(1, file_path=3), ("entry-wrong", "frames[1].file_path is 3")),
        (entry(1, fl_x=-5.0), ("entry-wrong", "frames[1]", "focal length is -5.0")),
        (entry(1, cx="left"), ("entry-wrong", "frames[1]", "cx is 'left'")),
        (entry(1, w=17), ("picture-size-wrong", "frames[1]", "17x")),
        (entry(1, frame_index=-1), ("entry-wrong", "frame_index is -1")),
        (lambda meta: meta.update(frames=[]), ("pictures-none",)),
        (lambda meta: meta.update(frames={"a": 1}), ("pictures-none",)),
        (lambda meta: meta["frames"].__setitem__(0, 5), ("entry-wrong", "frames[0] is 5")),
        (lambda meta: meta.update(devrf_scene={"near": 1}), ("entry-wrong", "devrf_scene")),
    ],
)
def test_transforms(folders, name: Any, change, refusal):
    path = folders[name] / TRANSFORMS[name]
    edit(path, change)
    with refused(*refusal, folders[name], kind=CaptureError):
        read_dataset(name, folders[name])


@pytest.mark.parametrize("name", TRANSFORMS)
@pytest.mark.parametrize(
    ("text", "code"),
    [("{", "file-damaged"), ("[1]", "file-damaged"), ("", "file-damaged"), ("\x00\xff", "encoding-wrong")],
)
def test_no_json(folders, name: Any, text, code):
    path = folders[name] / TRANSFORMS[name]
    path.write_bytes(text.encode("latin-1"))
    with refused(code, path, kind=CaptureError):
        read_dataset(name, folders[name])


@pytest.mark.parametrize("name", ["devrf", "blender"])
@pytest.mark.parametrize("value", [1.5, "now", float("nan")])
def test_times_outside_0_1(folders, name: Any, value):
    edit(folders[name] / TRANSFORMS[name], entry(3, time=value))
    with refused("entry-wrong", "frames[3]", f"time is {value!r}", "[0, 1]", kind=CaptureError):
        read_dataset(name, folders[name])


def test_times_that_are_missing_or_no_numbers(folders):
    edit(folders["devrf"] / TRAIN, lambda meta: meta["frames"][3].pop("time"))
    with refused("entry-missing", "frames[3]", "time", kind=CaptureError):
        read_dataset("devrf", folders["devrf"])
    edit(folders["nerfstudio"] / "transforms.json", entry(3, time="now"))
    with refused("entry-wrong", "frames[3]", "time is 'now'", kind=CaptureError):
        read_dataset("nerfstudio", folders["nerfstudio"])


def test_a_monocular_set_in_motion_has_no_scene_at_rest(folders):
    def give_times(meta: dict[str, Any]) -> None:
        for n, e in enumerate(meta["frames"]):
            e["time"] = n / len(meta["frames"])

    edit(folders["blender"] / "transforms_train.json", give_times)
    with refused("rest-missing", folders["blender"], kind=CaptureError):
        read_dataset("blender", folders["blender"])


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize(
    ("kind", "refusal"),
    [
        ("LA", ("picture-kind-unread", "2 channels")),
        ("text", ("picture-unreadable",)),
        ("gone", ("picture-missing",)),
        ("small", ("picture-size-wrong", "20x20")),
    ],
)
def test_pictures(folders, name: Any, kind, refusal):
    from PIL import Image

    victim = last_picture(folders[name])
    if kind == "gone":
        victim.unlink()
    elif kind == "text":
        victim.write_text("no picture")
    else:
        size = (20, 20) if kind == "small" else Image.open(victim).size
        Image.new("LA" if kind == "LA" else "RGB", size).save(victim)
    if kind == "gone" and name == "llff":
        refusal = ("count-mismatch", "found images")  # by the number of files: which is which is not known
    with refused(*refusal, kind=CaptureError):
        read_dataset(name, folders[name])


@pytest.mark.parametrize("name", LAYOUTS)
def test_grey_pictures_are_read_and_said(folders, name: Any):
    victim = last_picture(folders[name])
    cv2.imwrite(str(victim), np.ascontiguousarray(read_pixels(victim)[..., 0]))
    notes: list[str] = []
    read_dataset(name, folders[name], notes=notes)
    assert any("1 grey" in note and "RGB" in note for note in notes)


def test_mixed_sizes_within_a_camera(folders):
    def smaller(meta: dict[str, Any]) -> None:
        e = next(e for e in meta["frames"] if e["camera"] == "cam1" and e["frame_index"] == 3)
        path = folders["nerfstudio"] / e["file_path"]
        cv2.imwrite(str(path), np.zeros((20, 30, 3), np.uint8))
        e |= {"w": 30, "h": 20}

    edit(folders["nerfstudio"] / "transforms.json", smaller)
    with refused("picture-size-wrong", "000003.png", "30x20", "'cam1'", "80x56", kind=CaptureError):
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
    with refused("picture-size-wrong", "30x20", "camera_angle_x", kind=CaptureError):
        read_dataset("blender", folders["blender"])


@pytest.mark.parametrize(
    ("damage", "refusal"),
    [
        (
            lambda p: np.savez(p, flow=np.zeros((20, 30, 2)), mask=np.ones((20, 30))),
            ("flow-size-wrong", "[20, 30, 2]"),
        ),
        (lambda p: np.savez(p, flow=np.zeros((20, 30, 2))), ("file-damaged",)),
        (lambda p: p.write_text("no zip"), ("file-damaged",)),
        (lambda p: p.unlink(), ("file-missing",)),
    ],
)
def test_flow_files(folders, damage, refusal):
    damage(folders["devrf"] / "dynamic_2views/train_flow/005_bwd.npz")
    with refused(*refusal, "005_bwd.npz", kind=CaptureError):
        read_dataset("devrf", folders["devrf"])


@pytest.mark.parametrize(
    ("change", "refusal"),
    [
        (lambda t: t[:-1], ("count-mismatch", "5 pictures", "images 6")),
        (lambda t: t[:, :15], ("table-wrong", "[6, 15]", "17 numbers")),
        (
            lambda t: np.where(np.arange(17) == 15, -1.0, t),
            ("entry-wrong", "bounds of row 0", "0 < near < far"),
        ),
        (lambda t: np.where(np.arange(17) == 14, 0.0, t), ("entry-wrong", "row 0", "height, width, focal")),
        (lambda t: np.where(np.arange(17) == 3, np.nan, t), ("pose-not-finite", "row 0")),
        (lambda t: np.where(np.isin(np.arange(17), (1, 6, 11)), -t, t), ("pose-mirrored", "row 0")),
        (lambda t: np.where(np.arange(17) == 4, 3 * t, t), ("picture-size-wrong", "000000.png")),
    ],
)
def test_llff_tables(folders, change, refusal):
    path = folders["llff"] / "poses_bounds.npy"
    np.save(path, change(np.load(path)))
    with refused(*refusal, kind=CaptureError):
        read_dataset("llff", folders["llff"])


def test_llff_files(folders):
    path = folders["llff"] / "poses_bounds.npy"
    path.write_bytes(path.read_bytes()[:200])
    with refused("file-damaged", path, "dataset.format", kind=CaptureError):
        read_dataset("llff", folders["llff"])
    path.unlink()
    with refused("file-missing", path, kind=CaptureError):
        read_dataset("llff", folders["llff"])


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("kept", [0, 5, 40, -3])
def test_colmap_files_that_were_cut_off(folders, name, kept):
    path = folders["colmap"] / "sparse/0" / name
    path.write_bytes(path.read_bytes()[:kept])
    with refused("file-damaged", path, kind=CaptureError):
        read_dataset("colmap", folders["colmap"])


def test_colmap_text_that_is_none(folders):
    folder = folders["colmap"] / "sparse/0"
    (folder / "cameras.bin").unlink()
    for text in ("1 PINHOLE 40", "1 PINHOLE 40 30 1 2 3", "a PINHOLE c d e"):
        (folder / "cameras.txt").write_text(text)
        with refused("file-damaged", "cameras.txt", kind=CaptureError):
            read_dataset("colmap", folders["colmap"])
    (folder / "cameras.txt").write_text("1 NEW_MODEL 40 30 1 2 3")
    with refused("lens-unread", "cameras.txt", "NEW_MODEL", kind=CaptureError):
        read_dataset("colmap", folders["colmap"])
    (folder / "cameras.txt").write_text("")
    with refused("camera-missing", "camera 1", kind=CaptureError):
        read_dataset("colmap", folders["colmap"])


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_folder_of_another_format_and_none(tmp_path: Path, name: Any):
    with refused("folder-missing" if name == "devrf" else "file-missing", tmp_path, kind=CaptureError):
        read_dataset(name, tmp_path)
    with refused("folder-missing", tmp_path / "none", kind=CaptureError):
        read_dataset(name, tmp_path / "none")


@pytest.mark.parametrize("name", TRANSFORMS)
def test_json_of_windows_programs(folders: Folders, name: Any) -> None:
    path = folders[name] / TRANSFORMS[name]
    before, text = read_dataset(name, folders[name]), path.read_text()
    path.write_text(text, "utf-8-sig")
    assert read_dataset(name, folders[name]).frames[0].camera.width == before.frames[0].camera.width
    path.write_text(text, "utf-16")
    with refused("encoding-wrong", TRANSFORMS[name], "UTF-8", kind=CaptureError):
        read_dataset(name, folders[name])
