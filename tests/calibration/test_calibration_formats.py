"""Calibrations of other tools: what we write other libraries read, what others wrote we read."""

import csv
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.make.rigs import RIG_LAYOUTS
from tests.make.tables import table
from tests.refused import refused

from devrf.calibration.formats import find_calibration
from devrf.calibration.formats.opencv import storage
from devrf.calibration.formats.toml_tables import tomllib
from devrf.calibration.intrinsics import HALF_PIXEL
from devrf.calibration.rigs.given import read_given
from devrf.calibration.rigs.rig import Rig
from devrf.capture.camera import Camera
from devrf.capture.system.errors import InputError

LENSES = {  # name: width, height, fx, fy, cx, cy, distortion; names that do not sort as they are written
    "left": (1280, 720, 903.55, 907.88, 618.81, 394.71, [-0.332, 0.0464, -0.0043, 0.0041, 0.0666]),
    "cam10": (640, 480, 535.9, 534.2, 342.78, 236.07, [-0.266, -0.0386, 0.0018, -0.0003, 0.0]),
    "cam2": (1088, 1920, 1681.2, 1681.0, 533.47, 948.64, [0.0, 0.0, 0.0, 0.0, 0.0]),
    "wide": (800, 600, 300.0, 301.0, 401.0, 299.0, [0.05, -0.01, 0.003, -0.001, 0.0]),
}
FISHEYE = "wide"
GRID = np.stack(np.meshgrid([-0.6, 0.1, 0.5], [-0.4, 0.0, 0.3], [-0.5, 0.2, 0.6]), axis=-1).reshape(-1, 3)
EXACT_PX = 1e-9  # doubles carry 16 digits, pixels have 4 before the point: 1e-12, times a few operations


def rig_cameras() -> dict[str, Camera]:
    """Four cameras around the origin, 2 m away, looking at it, each rolled in its own way."""
    rng, out = np.random.default_rng(3), {}
    for n, (name, (width, height, fx, fy, cx, cy, lens)) in enumerate(LENSES.items()):
        angle = 0.9 * n
        centre = 2.0 * np.array([np.sin(angle), 0.2 * n - 0.2, -np.cos(angle)])
        z = -centre / np.linalg.norm(centre)
        up = np.array([0.0, 1.0, 0.0]) + 0.3 * rng.standard_normal(3)
        x = np.cross(up, z) / np.linalg.norm(np.cross(up, z))
        R = np.stack([x, np.cross(z, x), z])
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        model = "OPENCV_FISHEYE" if name == FISHEYE else "OPENCV"
        out[name] = Camera(width, height, K, np.column_stack([R, -R @ centre]), np.array(lens), model)
    return out


def written(format_name: str, folder: Path) -> tuple[dict[str, Camera], Path]:
    """The cameras, written; and what a user names in calibration.rig.given."""
    cameras = rig_cameras()
    if format_name in ("easymocap", "panoptic"):  # cannot say that a lens is a fisheye
        del cameras[FISHEYE]
    if format_name == "kalibr":  # its lens has no k3, its world is its first camera
        cameras = {n: replace(c, distortion=c.distortion * [1, 1, 1, 1, 0]) for n, c in cameras.items()}
        world = cameras["left"].cam_from_world
        turn = np.vstack([world, [0, 0, 0, 1]])
        cameras = {n: c.moved(turn) for n, c in cameras.items()}
    RIG_LAYOUTS[format_name](folder, cameras, True)
    files = list(folder.iterdir())
    return cameras, files[0] if len(files) == 1 and files[0].is_file() else folder


@pytest.mark.parametrize("format_name", RIG_LAYOUTS)
def test_written_and_read_back_it_is_the_same_rig(format_name: str, tmp_path: Path) -> None:
    cameras, given = written(format_name, tmp_path)
    names = list(cameras)
    if format_name == "rig-caliscope":  # numbers its cameras: read by number
        names = [f"cam{n}" for n in range(len(cameras))]
        cameras = dict(zip(names, cameras.values(), strict=True))
    found = read_given(given, names, {n: (c.width, c.height) for n, c in cameras.items()})
    assert found.rig is not None
    assert found.rig.scale.metric == (format_name != "rig-colmap")  # COLMAP has no unit
    for name, camera in cameras.items():
        back = found.rig.cameras[name].camera
        grid = GRID
        if format_name == "kalibr":  # the points, in the first camera's frame
            T = rig_cameras()["left"].cam_from_world
            grid = GRID @ T[:, :3].T + T[:, 3]
        pixels = camera.project(grid)
        assert np.isfinite(pixels).all() and back.model == camera.model
        np.testing.assert_allclose(back.project(grid), pixels, rtol=0, atol=EXACT_PX)
        assert (back.width, back.height) == (camera.width, camera.height)


def test_poses_of_llff_belong_to_the_clips_beside_them(tmp_path: Path) -> None:
    """By the order of their names; without clips a row has no camera's name, and all are taken in order."""
    cameras = {f"cam{n:02d}": c for n, c in zip((0, 3, 20), rig_cameras().values(), strict=False)}
    rows = []
    for camera in cameras.values():
        pose = np.linalg.inv(np.vstack([camera.cam_from_world, [0, 0, 0, 1]]))
        hwf = [camera.height, camera.width, camera.K[0, 0]]
        rows.append(
            [*np.column_stack([pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], hwf]).ravel(), 1.0, 5.0]
        )
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    for name in cameras:
        (tmp_path / f"{name}.mp4").touch()
    sizes = {n: (c.width, c.height) for n, c in cameras.items()}
    for names in (list(cameras), ["cam20"]):
        rig = read_given(tmp_path / "poses_bounds.npy", names, sizes).rig
        assert rig is not None and not rig.scale.metric
        for name in names:
            got = rig.cameras[name].camera
            np.testing.assert_allclose(got.cam_from_world, cameras[name].cam_from_world, atol=1e-9)
            assert got.K[0, 0] == cameras[name].K[0, 0] and got.K[0, 2] == got.width / 2
    for name in cameras:
        (tmp_path / f"{name}.mp4").unlink()
    with refused("camera-missing", "cam20", kind=InputError):
        read_given(tmp_path / "poses_bounds.npy", ["cam20"], sizes)
    np.save(tmp_path / "poses_bounds.npy", np.zeros((2, 3)))
    with refused("table-wrong", "poses_bounds.npy", kind=InputError):
        read_given(tmp_path / "poses_bounds.npy", ["cam20"], sizes)


def test_json_of_another_program_is_told_what_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"Calibration": {"cameras": []}}')
    with refused("file-damaged", "a.json", "multical", "OpenCV", kind=InputError):
        read_given(tmp_path / "a.json", ["cam0"], {"cam0": (640, 480)})


def opencv_pixels(K: object, lens: object, rotation: object, t: object, fisheye: bool) -> np.ndarray:
    """Where OpenCV's projectPoints sees the grid; its first pixel is at 0."""
    rotation = np.array(rotation, dtype=np.float64)
    rvec = rotation if rotation.size == 3 else cv2.Rodrigues(rotation)[0]
    K, lens, t = (np.array(v, dtype=np.float64) for v in (K, lens, t))
    if fisheye:
        return cv2.fisheye.projectPoints(GRID[:, None], rvec, t.reshape(3, 1), K, lens.ravel())[0].reshape(
            -1, 2
        )
    return cv2.projectPoints(GRID, rvec, t, K, lens)[0].reshape(-1, 2)


@pytest.mark.parametrize("format_name", ["rig-caliscope", "rig-opencv"])
def test_opencv_projects_what_is_written_half_a_pixel_less(format_name: str, tmp_path: Path) -> None:
    """The files as others read them, projected by OpenCV: centre of the first pixel at 0, ours at 0.5."""
    cameras, given = written(format_name, tmp_path)
    for n, (name, camera) in enumerate(cameras.items()):
        if given.suffix == ".toml":
            table = tomllib.loads(given.read_text())["cameras"][str(n)]
            values = [table[key] for key in ("matrix", "distortions", "rotation", "translation")]
        else:
            file = cv2.FileStorage(str(given / f"{name}.yml"), cv2.FILE_STORAGE_READ)
            T = file.getNode("cam_from_world").mat()
            keys = ("camera_matrix", "distortion_coefficients")
            values = [*(file.getNode(key).mat() for key in keys), T[:, :3], T[:, 3]]
        seen = opencv_pixels(*values, fisheye=name == FISHEYE)
        np.testing.assert_allclose(seen + 0.5, camera.project(GRID), rtol=0, atol=EXACT_PX)


def test_pycolmap_projects_what_is_written(tmp_path: Path) -> None:
    """pycolmap in a process of its own, as everywhere; its first pixel is at 0.5 as ours."""
    cameras, given = written("rig-colmap", tmp_path)
    program = (
        "import zlib, json, sys, numpy as np, pycolmap\n"
        "model = pycolmap.Reconstruction(sys.argv[1]); grid = np.array(json.loads(sys.argv[2]))\n"
        "out = {i.name: [i.project_point(p).tolist() for p in grid] for i in model.images.values()}\n"
        "print(json.dumps(out))"
    )
    command = [sys.executable, "-c", program, str(given / "sparse" / "0"), json.dumps(GRID.tolist())]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
    seen = json.loads(result.stdout.splitlines()[-1])
    assert set(seen) == {f"{name}.png" for name in cameras}
    for name, camera in cameras.items():
        np.testing.assert_allclose(seen[f"{name}.png"], camera.project(GRID), rtol=0, atol=1e-8)


# --- files that others wrote ---


def read_four(path: Path, names: list[str], size: tuple[int, int]) -> Rig:
    given = read_given(path, names, dict.fromkeys(names, size))
    assert given.rig is not None
    return given.rig


@pytest.mark.parametrize("file", ["camera_array.toml", "config.toml"])
def test_caliscope_projects_its_own_points_where_it_saw_them(file: str, data_dir: Path) -> None:
    """README of the data: median 0.89 px with these cameras and points triangulated anew; the stored points are older
    (1.15 px here). Other axes or another order of coefficients: tens of pixels."""
    folder = data_dir / "caliscope_post_optimization"
    names = [f"cam{n}" for n in range(4)]
    rig = read_four(folder / file, names, (1280, 720))
    tables = folder / "calibration" / "extrinsic" / "CHARUCO"
    with (tables / "xyz_CHARUCO.csv").open() as xyz, (tables / "xy_CHARUCO.csv").open() as xy:
        points = {
            (r["sync_index"], r["keypoint_id"]): [float(r[f"{a}_coord"]) for a in "xyz"]
            for r in csv.DictReader(xyz)
        }
        seen = [
            (int(r["cam_id"]), points[key], float(r["img_loc_x"]), float(r["img_loc_y"]))
            for r in csv.DictReader(xy)
            if (key := (r["sync_index"], r["keypoint_id"])) in points
        ]
    assert len(seen) > 2000
    off = [
        np.hypot(*(rig.cameras[f"cam{n}"].camera.project(np.array(p)) - 0.5 - [u, v])) for n, p, u, v in seen
    ]
    assert np.median(off) < 1.5
    assert rig.scale.metric


RAIL_PX = {  # both upper ends of the rail on the treadmill, clicked in calibration/extrinsics/camNN_ext.png
    "cam01": [(724.3, 1460.2), (228.4, 951.6)],
    "cam02": [(462.3, 1334.7), (619.8, 981.0)],
    "cam03": [(221.0, 1072.2), (922.0, 1384.7)],
    "cam04": [(731.5, 962.7), (523.7, 1582.3)],
}
RAIL_M = 2.0  # Config.toml, object_coords_3d: x = -2 and x = 0
RAIL_WIDTH_M = 0.02  # of the profile: which of its corners was clicked


def test_qualisys_cameras_see_one_rail_of_known_length(data_dir: Path) -> None:
    """Four lines of sight meet, and the two meeting points are as far apart as the rail is long.

    A corner taken for its neighbour is 2 cm off, 12 px in the nearest camera (2.9 m, 1675 px); two such and 5 px of
    clicking: 30 px. Length: two corners off, 4 cm. With mirrored or transposed axes lines miss by 90 to 800 px.
    """
    names = list(RAIL_PX)
    rig = read_four(data_dir / "pose2sim_single/calibration/Calib.qca.txt", names, (1088, 1920))
    cameras = {name: rig.cameras[name].camera for name in names}
    ends = []
    for end in range(2):
        pixels = {name: np.array(RAIL_PX[name][end]) + 0.5 for name in names}
        rays = {name: cameras[name].directions(pixels[name]) for name in names}
        A = sum(np.eye(3) - np.outer(d, d) for d in rays.values())
        b = sum((np.eye(3) - np.outer(d, d)) @ cameras[n].centre for n, d in rays.items())
        point = np.linalg.solve(np.asarray(A), np.asarray(b))
        ends.append(point)
        assert max(np.hypot(*(cameras[n].project(point) - pixels[n])) for n in names) < 30
    assert abs(np.linalg.norm(ends[0] - ends[1]) - RAIL_M) < 2 * RAIL_WIDTH_M
    assert rig.scale.metric


def test_qualisys_distortion_has_no_unit(data_dir: Path) -> None:
    """As written it fits photos of a chessboard better than divided by 64 like lengths, as Pose2Sim reads it."""
    folder = data_dir / "pose2sim_single" / "calibration"
    camera = read_four(folder / "Calib.qca.txt", list(RAIL_PX), (1088, 1920)).cameras["cam02"].camera
    board = np.pad(np.mgrid[:4, :7].T.reshape(-1, 2) * 0.06, ((0, 0), (0, 1)))
    K = camera.K - HALF_PIXEL
    for photo in ("cam02_01_int.jpg", "cam02_02_int.jpg"):
        grey = cv2.imread(str(folder / "intrinsics/int_cam02_img" / photo), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        found, corners = cv2.findChessboardCornersSB(grey, (4, 7), flags=cv2.CALIB_CB_ACCURACY)
        assert found
        seen = corners.reshape(-1, 2).astype(np.float64)
        rms = []
        for lens in (camera.distortion, camera.distortion / 64):
            _, rvec, t = cv2.solvePnP(board, seen, K, lens)
            off = cv2.projectPoints(board, rvec, t, K, lens)[0].reshape(-1, 2) - seen
            rms.append(np.sqrt((off**2).sum(1).mean()))
        assert rms[0] < 0.9 * rms[1]


def test_opencv_intrinsics_of_its_samples(data_dir: Path) -> None:
    folder = data_dir / "opencv_stereo_chessboard"
    single = find_calibration(folder / "left_intrinsics.yml").cameras["left_intrinsics"]
    assert single.size == (640, 480) and single.cam_from_world is None
    assert single.K[0, 0] == pytest.approx(535.9157, abs=1e-4)
    assert single.K[:2, 2] == pytest.approx([342.28315 + 0.5, 235.57083 + 0.5], abs=1e-4)
    assert single.distortion == pytest.approx([-0.26637, -0.03859, 0.00178, -0.00028, 0.23839], abs=1e-5)
    stereo = find_calibration(folder / "intrinsics.yml")
    assert list(stereo.cameras) == ["1", "2"] and stereo.unit == "unsaid"
    assert stereo.cameras["2"].distortion[0] == pytest.approx(-0.169164, abs=1e-6)


def test_opencv_stereo_pair_with_poses(data_dir: Path, tmp_path: Path) -> None:
    """x2 = R x1 + T: the second camera's centre is at -R^T T in the first one's frame."""
    text = (data_dir / "opencv_stereo_chessboard/intrinsics.yml").read_text()
    (tmp_path / "intrinsics.yml").write_text(text)
    R, T = cv2.Rodrigues(np.array([0.01, 0.02, -0.005]))[0], np.array([[-83.2], [1.0], [0.4]])
    file = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("R", R)
    file.write("T", T)
    file.release()
    for given in (tmp_path, tmp_path / "intrinsics.yml", tmp_path / "extrinsics.yml"):
        rig = read_given(given, ["left", "right"], dict.fromkeys(["left", "right"], (640, 480))).rig
        assert rig is not None
        np.testing.assert_array_equal(rig.cameras["left"].camera.centre, np.zeros(3))
        expected = 1e-3 * (-R.T @ T).ravel()  # 83 units apart are millimetres
        np.testing.assert_allclose(rig.cameras["right"].camera.centre, expected, atol=1e-12)


TABLE = table("calibrations")
LENS = [-0.31, 0.12, 0.001, -0.0005, -0.02]


def of_table(path: Path, text: str, words: dict[str, str]) -> Path:
    """A text of the table with some words replaced, in a file."""
    content = TABLE["texts"][text]
    for old, new in words.items():
        assert old in content
        content = content.replace(old, "1" + ":00" * 200 + ".0" if new == "MANY_COLONS" else new)
    path.write_text(content.replace("LENS", str(LENS)[1:-1]))
    return path


@pytest.mark.parametrize(("file", "text", "words", "code", "named"), TABLE["refused"])
def test_what_cannot_be_used_is_named(
    file: str, text: str, words: dict, code: str, named: list, tmp_path: Path
):
    with refused(code, tmp_path, *named, kind=InputError):
        find_calibration(of_table(tmp_path / file, text, words))


@pytest.mark.parametrize(("file", "text", "words", "expected"), TABLE["read"])
def test_what_files_of_others_say(file: str, text: str, words: dict, expected: dict, tmp_path: Path) -> None:
    found = find_calibration(of_table(tmp_path / file, text, words))
    camera = next(iter(found.cameras.values()))
    K, lens = camera.K, camera.distortion.tolist()
    said = {
        "size": list(camera.size or ()),
        "lens": LENS if lens == LENS else lens,
        "k2": lens[1],
        "unit": found.unit,
    }
    said["K"] = pytest.approx([K[0, 0], K[1, 1], *K[:2, 2]])
    assert {key: said[key] for key in expected} == expected | (
        {"lens": LENS} if expected.get("lens") == "LENS" else {}
    )


@pytest.mark.parametrize("key", TABLE["other_names"])
def test_a_lens_under_another_name(key: str, tmp_path: Path) -> None:
    matrix = f"{key}: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: {LENS}"
    for file, text, line in (
        ("a.yml", "matrix", f"{key}: {LENS}"),
        ("b.yml", "matrix", matrix),
        ("c.toml", "bare", f"{key} = {LENS}"),
    ):
        found = find_calibration(of_table(tmp_path / file, text, {"LENS": line}))
        assert [c.distortion.tolist() for c in found.cameras.values()] == [LENS], file
    path = of_table(tmp_path / "d.yaml", "kalibr", {"distortion_coeffs": key})
    assert find_calibration(path).cameras["cam0"].distortion[1] == 0.06712482


def test_kalibr_has_poses_from_camera_to_camera(tmp_path: Path) -> None:
    rig = read_four(of_table(tmp_path / "camchain.yaml", "kalibr", {}), ["cam0", "cam1"], (752, 480))
    np.testing.assert_allclose(rig.cameras["cam1"].camera.centre, [0.11, -0.002, -0.003], atol=1e-15)


def test_ros_camera_info_has_no_yaml_line() -> None:
    assert storage(TABLE["texts"]["ros"]) is not None
