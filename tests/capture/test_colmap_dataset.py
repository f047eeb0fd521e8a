"""COLMAP's text models, written here by hand; binary ones are in test_export.py."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.formats import find_calibration
from devrf.capture.formats import read_dataset
from devrf.capture.formats.colmap.colmap_model import MODELS, Model, ModelCamera, ModelImage, write_model
from devrf.capture.system.errors import CaptureError

POSES = ("1 0 0 0 0.1 0.2 3", "0.9238795325112867 0 0.3826834323650898 0 0 0 3", "2 0 0 0 -1 0 3")


def colmap_text(folder: Path, camera: str) -> None:
    """Three pictures, two points seen by all and one by two; one line of keypoints is empty."""
    model = folder / "sparse"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(f"# Camera list\n7 {camera}\n")
    lines = ["# Image list"]
    for n, pose in enumerate(POSES):
        (folder / "images").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "images" / f"a {n}.png"), np.full((32, 48, 3), 100, np.uint8))
        lines += [f"{n + 3} {pose} 7 a {n}.png", "" if n == 2 else "1.5 2.5 11 3.5 4.5 -1"]
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "points3D.txt").write_text(
        "11 0 0 1 9 9 9 0.5 3 0 4 0 5 0\n12 0.1 0 1 9 9 9 5.0 3 0 4 0 5 0\n"
        "13 0 0.5 1 9 9 9 0.5 3 0 4 0\n14 0 1 2 9 9 9 0.1 5 0 4 1 3 1\n"
    )


@pytest.mark.parametrize(
    ("camera", "K", "lens"),
    [
        ("SIMPLE_PINHOLE 48 32 40 23 15", [40, 40, 23, 15], [0, 0, 0, 0, 0]),
        ("PINHOLE 48 32 40 41 23 15", [40, 41, 23, 15], [0, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL 48 32 40 23 15 0.1", [40, 40, 23, 15], [0.1, 0, 0, 0, 0]),
        ("RADIAL 48 32 40 23 15 0.1 0.2", [40, 40, 23, 15], [0.1, 0.2, 0, 0, 0]),
        ("OPENCV 48 32 40 41 23 15 .1 .2 .3 .4", [40, 41, 23, 15], [0.1, 0.2, 0.3, 0.4, 0]),
        ("FULL_OPENCV 48 32 40 41 23 15 .1 .2 .3 .4 .5 0 0 0", [40, 41, 23, 15], [0.1, 0.2, 0.3, 0.4, 0.5]),
    ],
)
def test_colmap_text(tmp_path: Path, camera, K, lens):
    colmap_text(tmp_path, camera)
    scene = read_dataset("colmap", tmp_path, holdout_every=2)
    assert [(f.path.name, f.split) for f in scene.static] == [
        ("a 0.png", "test"),
        ("a 1.png", "train"),
        ("a 2.png", "test"),
    ]
    camera = scene.static[1].camera
    assert [camera.K[0, 0], camera.K[1, 1], *camera.K[:2, 2]] == K
    np.testing.assert_array_equal(camera.distortion, lens)
    np.testing.assert_allclose(camera.cam_from_world[0], [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-12)
    np.testing.assert_allclose(scene.static[2].camera.centre, [1, 0, -3])  # its quaternion had length 2
    assert scene.points is not None  # one point has too large an error, one is seen twice only
    np.testing.assert_array_equal(scene.points.xyz, [[0, 0, 1], [0, 1, 2]])
    assert scene.points.obs_frame.tolist() == [0, 1, 2, 0, 1, 2]


@pytest.mark.parametrize(
    ("camera", "K", "lens"),
    [
        ("SIMPLE_FISHEYE 48 32 40 23 15", [40, 40], [0, 0, 0, 0, 0]),
        ("FISHEYE 48 32 40 41 23 15", [40, 41], [0, 0, 0, 0, 0]),
        ("SIMPLE_RADIAL_FISHEYE 48 32 40 23 15 .1", [40, 40], [0.1, 0, 0, 0, 0]),
        ("RADIAL_FISHEYE 48 32 40 23 15 .1 .2", [40, 40], [0.1, 0.2, 0, 0, 0]),
        ("OPENCV_FISHEYE 48 32 40 41 23 15 .1 .2 .3 .4", [40, 41], [0.1, 0.2, 0.3, 0.4, 0]),
    ],
)
def test_equidistant_lenses_project_as_colmap_says(tmp_path: Path, camera, K, lens):
    colmap_text(tmp_path, camera)
    found = read_dataset("colmap", tmp_path).static[0].camera
    assert (found.model, found.K[0, 0], found.K[1, 1]) == ("OPENCV_FISHEYE", *K)
    np.testing.assert_array_equal(found.distortion, lens)
    x, y = 0.9, -0.4  # COLMAP: theta (1 + k1 theta^2 + k2 theta^4 + ...) along the direction in the picture
    radius = np.hypot(x, y)
    theta = np.arctan(radius)
    bent = theta * (1 + sum(k * theta ** (2 * n) for n, k in enumerate(lens[:4], 1))) / radius
    ray = np.linalg.inv(np.vstack([found.cam_from_world, [0, 0, 0, 1]]))[:3] @ [x, y, 1, 1]
    np.testing.assert_allclose(found.project(ray), [K[0] * x * bent + 23, K[1] * y * bent + 15], atol=1e-9)


@pytest.mark.parametrize(
    "camera",
    [
        "FOV 48 32 40 41 23 15 .1",
        "SIMPLE_DIVISION 48 32 40 23 15 .1",
        "DIVISION 48 32 40 41 23 15 .1",
        "EUCM 48 32 40 41 23 15 .5 1",
        "EQUIRECTANGULAR 48 32 48 32",
        "OF_TOMORROW 48 32 1",
    ],
)
def test_colmap_lenses_that_are_not_read_are_named(tmp_path: Path, camera: str):
    colmap_text(tmp_path, camera)
    with refused("lens-unread", camera.split()[0], "undistort", kind=CaptureError):
        read_dataset("colmap", tmp_path)


def test_lens_models_of_a_colmap_to_come_are_named_by_number(tmp_path: Path):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    head = struct.pack("<QiiQQ", 1, 7, 99, 48, 32)
    (tmp_path / "sparse/cameras.bin").write_bytes(head + struct.pack("<3d", 40, 23, 15))
    with refused("lens-unread", "cameras.bin", "number 99", "undistort", kind=CaptureError):
        read_dataset("colmap", tmp_path)


def test_lens_models_have_the_numbers_and_parameters_of_colmap():
    code = (
        "import json, zlib, pycolmap\n"
        "models = [m for m in pycolmap.CameraModelId.__members__.values() if int(m) >= 0]\n"
        "make = pycolmap.Camera.create_from_model_id\n"
        "print(json.dumps([[int(m), m.name, len(make(1, m, 50.0, 48, 32).params)] for m in models]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert len(found) >= 12  # the first of pycolmap 4 has fewer than we know
    assert all(MODELS[number] == (name, count) for number, name, count in found)


def numbered_model(folder: Path, number: int, names: list[str], binary: bool) -> None:
    """`sparse/<number>` with these pictures of `colmap_text`, without points."""
    images = {
        n + 1: ModelImage(name, 7, np.array([1.0, 0, 0, 0]), np.array([0.1 * n, 0, 3]))
        for n, name in enumerate(names)
    }
    place = folder / "sparse" / str(number)
    write_model(place, Model({7: ModelCamera("SIMPLE_PINHOLE", 48, 32, (40.0, 23.0, 15.0))}, images, {}))
    if not binary:
        lines = [f"{n} 1 0 0 0 {image.translation[0]} 0 3 7 {image.name}\n" for n, image in images.items()]
        (place / "images.txt").write_text("\n".join(lines) + "\n")
        (place / "images.bin").unlink()


@pytest.mark.parametrize("binary", [True, False])
def test_of_several_models_the_largest_is_read(tmp_path: Path, binary: bool):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    for file in (tmp_path / "sparse").iterdir():
        file.unlink()
    for number, count in ((0, 1), (1, 2), (10, 1)):
        numbered_model(tmp_path, number, [f"a {n}.png" for n in range(count)], binary)
    notes: list[str] = []
    scene = read_dataset("colmap", tmp_path, notes=notes)
    assert [f.path.name for f in scene.static] == ["a 0.png", "a 1.png"]
    assert "sparse/0 1" in notes[0] and "sparse/1 2" in notes[0] and "sparse/10 1" in notes[0]
    assert "2 of the 3" in notes[1]
    found = find_calibration(tmp_path)
    assert list(found.cameras) == ["a 0", "a 1"]
    assert list(found.notes) == notes[:1]
    numbered_model(tmp_path, 2, ["a 2.png", "a 1.png"], binary)  # as large: the first of them
    assert {f.path.name for f in read_dataset("colmap", tmp_path).static} == {"a 0.png", "a 1.png"}


def test_a_damaged_model_beside_another_is_named(tmp_path: Path):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    numbered_model(tmp_path, 0, ["a 0.png"], True)
    (tmp_path / "sparse/0/images.bin").write_bytes(b"")
    with refused("file-damaged", "sparse/0/images.bin", kind=CaptureError):
        read_dataset("colmap", tmp_path)


SIGNATURE = b"\xef\xbb\xbf"  # as Windows programs put it before UTF-8


def model_files(folder: Path) -> list[Path]:
    return sorted((folder / "sparse").glob("*.txt"))


def same_cameras(folder: Path, other: Path) -> None:
    a, b = (read_dataset("colmap", place).static for place in (folder, other))
    assert [f.path.name for f in a] == [f.path.name for f in b]
    for first, second in zip(a, b, strict=True):
        np.testing.assert_array_equal(first.camera.cam_from_world, second.camera.cam_from_world)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: SIGNATURE + text,
        lambda text: text.replace(b"\n", b"\r\n"),
        lambda text: text.replace(b"list\n", b"list\n\n\n"),  # below the comment
        lambda text: text.replace(b".png\n\n", b".png\n"),  # an image without its line of keypoints
        lambda text: text.replace(b"-1\n", b"-1\n\n"),  # below an image's keypoints
        # known poses without second lines
        lambda text: text.replace(b".png\n1.5 2.5 11 3.5 4.5 -1\n", b".png\n"),
        lambda text: text + b"\n\n",
    ],
)
def test_colmap_text_as_others_leave_it(tmp_path: Path, change):
    for name in ("plain", "changed"):
        colmap_text(tmp_path / name, "SIMPLE_PINHOLE 48 32 40 23 15")
    for file in model_files(tmp_path / "changed"):
        file.write_bytes(change(file.read_bytes()))
    same_cameras(tmp_path / "changed", tmp_path / "plain")


def test_keypoints_that_are_cut_off_and_text_in_utf_16_are_named(tmp_path: Path):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    file = tmp_path / "sparse/images.txt"
    whole = file.read_text()
    file.write_text(whole.replace("4.5 -1", "4.5"))
    with refused("file-damaged", "images.txt", "1.5 2.5 11 3.5 4.5", "two lines", kind=CaptureError):
        read_dataset("colmap", tmp_path)
    file.write_text(whole)
    for name in ("sparse/test.txt", "sparse/cameras.txt"):
        (tmp_path / name).write_text("7 SIMPLE_PINHOLE 48 32 40 23 15\n", "utf-16")
        with refused("encoding-wrong", name, "UTF-8", kind=CaptureError):
            read_dataset("colmap", tmp_path)


def test_a_list_of_test_pictures_with_a_signature(tmp_path: Path):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    (tmp_path / "sparse/test.txt").write_bytes(SIGNATURE + b"a 0.png\r\na 2.png\r\n")
    assert [f.split for f in read_dataset("colmap", tmp_path).static] == ["test", "train", "test"]


def test_names_with_backslashes(tmp_path: Path):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    (tmp_path / "images/left").mkdir()
    for n in range(3):
        (tmp_path / f"images/a {n}.png").rename(tmp_path / f"images/left/{n}.png")
    file = tmp_path / "sparse/images.txt"
    file.write_text(file.read_text().replace("7 a ", "7 left\\"))
    (tmp_path / "sparse/test.txt").write_text("left/1.png\n")
    assert [f.split for f in read_dataset("colmap", tmp_path).static] == ["train", "test", "train"]
    # one picture: a fixed camera
    file.write_text("".join(line + "\n" for line in file.read_text().splitlines()[:3]))
    assert list(find_calibration(tmp_path).cameras) == ["left"]


@pytest.mark.parametrize(
    "points",
    [
        "11 0 0 1 9 9 9 0.5\n12 1 0 1 9 9 9 0.5\n",
        "11 0 0 1 9 9 9 2.5 3 0 4 0 5 0\n12 1 0 1 9 9 9 0.5 3 0 4 0\n",
    ],
)
def test_points_of_which_none_is_used_are_counted(tmp_path: Path, points: str):
    colmap_text(tmp_path, "SIMPLE_PINHOLE 48 32 40 23 15")
    notes: list[str] = []
    read_dataset("colmap", tmp_path, notes=notes)
    assert not any("points" in note for note in notes)  # some are used
    (tmp_path / "sparse/points3D.txt").write_text(points)
    assert read_dataset("colmap", tmp_path, notes=notes).points is None
    few = 2 if "3 0 4 0" not in points else 1
    assert notes[-1].startswith("2 sparse points") and f" {few} name fewer than 3" in notes[-1]
