"""`devrf-pipeline init`: which file is what, by content before name, and what is written and said."""

import errno
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.make.datasets import write_set
from tests.refused import refused

from devrf.calibration.boards.guess import BoardGuess, board_pictures, guess_board
from devrf.calibration.boards.spec import BoardSpec, dictionary
from devrf.calibration.preview.stability import Steadiness, steadiness
from devrf.capture.formats import read_dataset
from devrf.capture.ingest.survey import Footage
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.scene import Scene
from devrf.capture.system.errors import CaptureError, InputError
from devrf.capture.video.reader import probe_video
from devrf.capture.video.video_writer import write_video
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.init.calibrations import take_calibration
from devrf.pipelines.init.init_command import init
from devrf.pipelines.init.material import FootageContent, Roles
from devrf.pipelines.init.roles import guess_roles
from devrf.pipelines.init.scene_yaml import scene_yaml
from devrf.pipelines.terminal.console import Talk

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "workshop"
STANDS = Steadiness(True, 1e-4, 1.0)
MOVES = Steadiness(False, np.nan, 0.0)
UNKNOWN = Steadiness(None, np.nan, 0.0)
GUESS = BoardGuess(BoardSpec("charuco", (8, 6), 1.0, 0.75, "DICT_5X5_50", False, False), 23)


# --- boards ---

BOARD_PX = 270  # length of the boards that are drawn


def drawn(spec: BoardSpec) -> np.ndarray:
    """A print of the board on white paper."""
    columns, rows = spec.squares
    if spec.type == "chessboard":
        squares = np.kron(np.indices((rows + 1, columns + 1)).sum(0) % 2, np.ones((60, 60))) * 255
        return np.pad(squares, 60, constant_values=255).astype(np.uint8)
    if spec.type == "aruco_grid":
        grid = cv2.aruco.GridBoard(
            spec.squares, 1.0, 1 / (spec.marker_m or 1) - 1, dictionary(spec.dictionary)
        )
        return grid.generateImage((120 * columns, 120 * rows), marginSize=20)
    board = cv2.aruco.CharucoBoard(spec.squares, 1.0, spec.marker_m or 1, dictionary(spec.dictionary))
    board.setLegacyPattern(spec.legacy is True)
    image = board.generateImage((100 * columns, 100 * rows), marginSize=40)
    return 255 - image if spec.inverted else image


@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(
            BoardSpec("charuco", (8, 6), 1.0, 0.75, "DICT_5X5_50", False, False), marks=pytest.mark.full
        ),
        BoardSpec("charuco", (5, 7), 1.0, 0.7, "DICT_4X4_50", True, False),
        BoardSpec("charuco", (6, 4), 1.0, 0.75, "DICT_6X6_50", False, True),
        BoardSpec("aruco_grid", (5, 4), 1.0, 0.8, "DICT_4X4_50", False, False),
        BoardSpec("chessboard", (9, 6), 1.0, inverted=False, legacy=False),
    ],
    ids=lambda spec: f"{spec.type} {spec.squares}",
)
def test_a_board_photographed_from_two_sides_tells_its_layout(spec: BoardSpec) -> None:
    rng, image, pictures = np.random.default_rng(0), drawn(spec), []
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    for _ in range(2):
        place = corners * BOARD_PX / max(width, height) + (90, 40) + rng.uniform(-30, 30, (4, 2))
        H = cv2.getPerspectiveTransform(corners, place.astype(np.float32))
        around = 255 if spec.type == "chessboard" else 120
        seen = cv2.warpPerspective(image, H, (480, 360), flags=cv2.INTER_AREA, borderValue=around)
        pictures.append(cv2.GaussianBlur(seen, (0, 0), 0.7))
    found = guess_board(pictures)
    assert found is not None and found.spec == replace(spec, marker_m=found.spec.marker_m)
    if spec.marker_m is not None:  # each side of a marker is found to half a pixel
        assert found.spec.marker_m == pytest.approx(spec.marker_m, abs=max(spec.squares) / BOARD_PX)
    assert board_pictures(pictures, found) == len(pictures)


@pytest.mark.full
def test_a_mirrored_board_is_named_and_not_proposed(tmp_path: Path) -> None:
    """Its squares look like a chessboard, which `run` would search for in vain."""
    board = drawn(BoardSpec("charuco", (7, 5), 1.0, 0.75, "DICT_4X4_50", False, False))
    pictures = []
    for n in range(2):
        page = np.full((360, 480), 128, np.uint8)
        page[20 + 10 * n : 300 + 10 * n, 40:432] = cv2.resize(board, (392, 280), interpolation=cv2.INTER_AREA)
        pictures.append(np.ascontiguousarray(page[:, ::-1]))
    assert guess_board(pictures) is None
    clip = seen("board_cam0.mp4")
    look = replace(clip.look, pictures=tuple(np.stack([p] * 3, axis=-1) for p in pictures))
    roles = guess_roles([SWEEP, seen("cam0.mp4"), replace(clip, look=look)], None)
    assert "mirror" in roles.left["board_cam0.mp4"] and "DICT_4X4_50" in roles.left["board_cam0.mp4"]


def test_a_room_is_no_board(textures: Callable[[int], np.ndarray]) -> None:
    assert guess_board([textures(n)[:, :, 0] for n in range(4)]) is None


@pytest.mark.full
def test_real_chessboard_photos(data_dir: Path) -> None:
    files = sorted((data_dir / "caliscope_chessboard_intrinsic").glob("cam_0*.jpg"))[:3]
    found = guess_board([read_grey(file) for file in files])
    assert found is not None
    assert found.spec.squares == (9, 6)  # its README


# --- movement ---


def test_a_camera_stands_or_moves(textures: Callable[[int], np.ndarray]) -> None:
    room = textures(0)[:, :, 0]
    still = [room.copy() for _ in range(8)]
    for n, picture in enumerate(still):
        cv2.circle(picture, (60 + 40 * n, 120), 40, 255, -1)  # the subject
    assert steadiness(still).stands is True
    large = np.tile(np.hstack([room, textures(1)[:, :, 0]]), (1, 2))
    walk = [large[:, 90 * n : 90 * n + 480] for n in range(8)]
    assert steadiness(walk).stands is False
    assert steadiness([np.full((240, 320), 90, np.uint8)] * 4).stands is None


# --- roles ---


def seen(
    name: str, steady: Steadiness = STANDS, board: float = 0.0, level: int = 100, size: tuple[int, int] = (1920, 1080),
    is_clip: bool = True, count: int = 100, seconds: float = 4.0,
) -> FootageContent:  # fmt: skip
    times = np.linspace(0, seconds, count) if is_clip else np.zeros(0)
    pictures = (np.full((36, 48, 3), level, np.uint8),) * 3
    return FootageContent(
        Footage(Path(name), is_clip, *size, count, is_clip, "", (), times, pictures), name, steady, board
    )


def photos(name: str, steady: Steadiness = UNKNOWN, **more: Any) -> FootageContent:
    return seen(name, steady, is_clip=False, **more)


def roles_of(*files: FootageContent) -> Roles:
    return guess_roles(files, GUESS if any(f.board_share for f in files) else None)


def names(clips: dict[str, FootageContent]) -> dict[str, str]:
    return {camera: s.name for camera, s in clips.items()}


SWEEP = seen("static.mp4", MOVES)


@pytest.mark.parametrize(
    ("files", "sweep", "cameras", "left"),
    [
        # names of a camera card tell nothing: content decides
        ([seen("IMG_1.MOV", MOVES), seen("IMG_2.MOV"), seen("IMG_3.MOV"), seen("IMG_4.MOV", board=0.9)],
         "IMG_1.MOV", "IMG_2 IMG_3", "IMG_4.MOV"),
        # and it wins over names
        ([SWEEP, seen("cam0.mp4"), seen("cam1.mp4", MOVES)], "static.mp4", "cam0", "cam1.mp4"),
        ([seen("static.mp4"), seen("walk1.mp4", MOVES), seen("cam0.mp4")], "walk1.mp4", "cam0", "static.mp4"),
        ([SWEEP, seen("cam0.mp4"), seen("board_cam0.mp4")], "static.mp4", "cam0", "board_cam0.mp4"),
        ([seen("cam0.mp4", MOVES)], "cam0.mp4", "", ""),
        # the longer of two sweeps; black clips; too few photos; too little to see
        ([seen("walk_a.mp4", MOVES), seen("walk_b.mp4", MOVES, count=300), seen("cam0.mp4", UNKNOWN)],
         "walk_b.mp4", "cam0", "walk_a.mp4"),
        ([SWEEP, seen("cam1.mp4", level=2), photos("stills", count=5)], "static.mp4", "", "cam1.mp4 stills"),
        ([photos("sweep", count=2), seen("cam0.mp4")], "", "cam0", "sweep"),
        ([photos("sweep", count=3), seen("cam0.mp4")], "sweep", "cam0", ""),  # `check` refuses fewer than three
        ([photos("static", STANDS)], "", "", "static"),
    ],
)  # fmt: skip
def test_roles(files: list[FootageContent], sweep: str, cameras: str, left: str) -> None:
    roles = roles_of(*files)
    assert (roles.sweep.name if roles.sweep else "") == sweep
    assert list(roles.cameras) == cameras.split() and sorted(roles.left) == left.split()
    assert bool(roles.doubts) >= (not sweep)  # what is missing is said


def test_a_board_clip_belongs_by_name_by_folder_or_by_size() -> None:
    roles = roles_of(
        SWEEP, seen("cam1.mp4"), seen("cam11.mp4", size=(1280, 720)), seen("c/gopro.mp4"),
        seen("charuco_static.mp4", board=1.0), seen("charuco_cam1.mp4", board=1.0), seen("c/board.mp4", board=1.0),
        seen("calibration.mp4", board=1.0, size=(1280, 720)),
    )  # fmt: skip
    assert names(roles.boards) == {
        "static": "charuco_static.mp4", "cam1": "charuco_cam1.mp4", "gopro": "c/board.mp4", "cam11": "calibration.mp4",
    }  # fmt: skip
    longest = roles_of(SWEEP, seen("cam.mp4"), seen("cam_b.mp4"), seen("board_cam_b.mp4", board=1.0))
    assert names(longest.boards) == {"cam_b": "board_cam_b.mp4"}


def test_board_clips_of_cameras_with_names_of_other_alphabets_and_with_long_ones() -> None:
    """A name longer than a camera's may be is cut, and still known in its board clip's."""
    long = [
        f"{'take of the second day in the large hall by the window ' * 3}{side}" for side in ("left", "right")
    ]
    cameras = ["левая", "правая", "カメラ左", *long]
    roles = roles_of(
        SWEEP,
        *(seen(f"{name}.mp4") for name in cameras),
        *(
            seen(f"{word}_{name}.mp4", board=1.0)
            for word, name in zip(("доска", "board", "盤", "board", "calib"), cameras, strict=True)
        ),
    )
    assert not roles.left and len(roles.cameras) == len(cameras)
    for name, camera in roles.cameras.items():
        assert roles.boards[name].name.endswith(f"_{camera.name}")


def test_photos_of_a_board_are_no_sweep() -> None:
    roles = roles_of(
        SWEEP, seen("clips/cam1.mp4"), photos("intrinsics/int_cam1_img", board=0.4, count=7),
        photos("photos", STANDS, board=0.9, size=(1280, 720)),
    )  # fmt: skip
    assert names(roles.boards) == {"cam1": "intrinsics/int_cam1_img"} and list(roles.left) == ["photos"]
    roles = roles_of(photos("photos", MOVES, board=0.9))
    assert roles.sweep is not None and any(text.startswith("photos: ") for text in roles.doubts)


def test_board_clips_are_joint_where_they_can_be() -> None:
    """Without a sweep, and where every camera has one as long as the others', or all see it in their own clips."""
    cameras = [seen("cam0.mp4"), seen("cam1.mp4")]
    boards = [seen("board_cam0.mp4", board=1.0), seen("board_cam1.mp4", board=1.0)]
    assert list(roles_of(*cameras, *boards).joint) == ["cam0", "cam1"]
    assert roles_of(*cameras, *boards, SWEEP).joint == {}
    boards[1] = seen("board_cam1.mp4", board=1.0, seconds=9.0)
    assert roles_of(*cameras, *boards).joint == {}
    own = roles_of(seen("cam0.mp4", board=0.9), seen("cam1.mp4", board=0.8))
    assert names(own.joint) == {"cam0": "cam0.mp4", "cam1": "cam1.mp4"}
    assert roles_of(seen("cam0.mp4", board=0.9), seen("cam1.mp4")).joint == {}


POSE2SIM = (
    "[cam_{0}]\nname = 'cam{0}'\nsize = [{1}, {2}]\nmatrix = [[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], "
    "[0.0, 0.0, 1.0]]\ndistortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.{0}, 0.0]\n"
    "translation = [{0}.0, 0.0, 0.0]\nfisheye = false\n"
)  # of camera {0} in pictures {1} x {2}; lengths are in metres


def test_names_become_cameras_and_the_file_is_what_run_takes(tmp_path: Path) -> None:
    cameras = ["no.mp4", "null/clip.mp4", "gopro 2/GX01.mp4", "gopro 3/GX01.mp4", "wit.mp4"]
    files = [seen("walk/a: 1.mp4", MOVES, board=0.3), *map(seen, cameras), seen("board_x.mp4")]
    roles = guess_roles(files, GUESS)
    path = tmp_path / "scene.yaml"
    path.write_text(scene_yaml("on", roles, "tiny"))
    config = load_scene(path, check_files=False)
    schema = path.read_text().splitlines()[0].removeprefix("# yaml-language-server: $schema=file://")
    assert Path(schema).name == "scene.schema.json" and Path(schema).is_file()
    assert config.name == "on" and config.capture is not None
    assert config.capture.static == "walk/a: 1.mp4" and config.capture.rest == "auto"
    assert set(config.capture.cameras.values()) == set(cameras)
    assert "gopro_2" in config.capture.cameras
    board = config.capture.board
    assert board is not None and not board.metric and board.squares == (8, 6)


# --- the command ---


@pytest.mark.full
def test_the_example_without_its_scene(devrf: Callable, tmp_path: Path) -> None:
    """Every role of the example from its clips alone; the truth beside them is not read."""
    for clip in EXAMPLE.glob("*.mp4"):
        (tmp_path / clip.name).symlink_to(clip)
    result = devrf("init", tmp_path, "--name", "workshop")
    assert result.code == 0, result.said
    config, told = load_scene(tmp_path / "scene.yaml"), load_scene(EXAMPLE / "scene.yaml")
    assert config.capture is not None and told.capture is not None and told.capture.board is not None
    for key in ("static", "cameras", "test_cameras"):
        assert getattr(config.capture, key) == getattr(told.capture, key), key
    board = config.capture.board
    assert board is not None and board.clips == told.capture.board.clips
    assert board.squares == told.capture.board.squares
    assert not board.metric  # nobody can see how large a square is
    assert "square_m" in result.out
    again = devrf("init", tmp_path)
    assert again.code == 2 and "--force" in again.err and "[file-exists]" in again.err


def test_a_folder_of_nothing_is_named(tmp_path: Path, textures: Callable[[int], np.ndarray]) -> None:
    def said() -> str:
        with refused("folder-without-clips", tmp_path, kind=InputError) as error:
            init(Talk("quiet"), tmp_path, None, False)
        assert not (tmp_path / "scene.yaml").exists()
        return str(error.value)

    assert said().count("\n") == 1  # nothing was seen
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"{n}.jpg"), textures(n))
    (tmp_path / "cam0.mp4").write_text("This is no video.\n" * 50)
    write_video(tmp_path / "dark.mp4", [np.zeros((120, 160, 3), np.uint8)] * 12, 25.0)
    told = said()
    with refused("file-is-text") as why:
        probe_video(tmp_path / "cam0.mp4")
    for words in (".: 3 of the 8 ", str(why.value).removeprefix(f"{tmp_path}/"), "dark.mp4: black"):
        assert f"\n  {words}" in told


def test_fixed_cameras_alone_are_placed_by_a_calibration_or_refused(
    tmp_path: Path, textures: Callable[[int], np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    for n in range(2):
        frames = [textures(n)[:240, :320].copy() for _ in range(8)]
        for k, frame in enumerate(frames):
            cv2.circle(frame, (60 + 20 * k, 100), 20, (250, 250, 250), -1)
        write_video(tmp_path / f"cam{n}.mp4", frames, 25.0)

    def calibrate(name: str, *widths: int) -> None:
        (tmp_path / name).write_text("".join(POSE2SIM.format(n, w, 240) for n, w in enumerate(widths)))

    calibrate("Calib_other.toml", 320, 400)
    with refused("rig-without-source", tmp_path, kind=InputError):
        init(Talk(), tmp_path, None, False)
    assert not (tmp_path / "scene.yaml").exists()
    said = capsys.readouterr().out
    for words in ("fixed camera cam0", "sound track: cam0, cam1", "no sweep", "camera 'cam1'", "400x240"):
        assert words in said
    calibrate("Calib_rig.toml", 320, 320)
    init(Talk(), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.calibration.rig.given == "Calib_rig.toml"
    assert "# not used: Calib_other.toml: " in (tmp_path / "scene.yaml").read_text()


def test_a_calibration_in_metres_leaves_no_scale_unknown(tmp_path: Path) -> None:
    file = tmp_path / "Calib.toml"
    file.write_text("".join(POSE2SIM.format(n, 1920, 1080) for n in range(2)))
    for files in ([], [file]):
        roles = roles_of(seen("cam0.mp4", board=0.3), seen("cam1.mp4"))  # the board lies in the scene
        take_calibration(tmp_path, files, roles)
        assert roles.metric is bool(files)
        assert ("arbitrary" in scene_yaml("x", roles, "fast")) is not bool(files)


def test_a_full_disk_leaves_the_file_that_was_there(
    odd_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tmp_path /= "set"
    write_set("nerfstudio", odd_scene, tmp_path)
    before = sorted(tmp_path.iterdir())
    (tmp_path / "scene.yaml").write_text("name: mine")

    def full(path: Path, text: str, **_: str) -> int:
        with path.open("w") as file:
            file.write(text[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError) as caught:
        init(Talk("quiet"), tmp_path, None, True)
    assert caught.value.errno == errno.ENOSPC
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "scene.yaml"])
    assert (tmp_path / "scene.yaml").read_text() == "name: mine"


def test_a_data_set_is_told(odd_scene: Scene, tmp_path: Path) -> None:
    """One that can be read; of one that cannot, why; LLFF's poses beside a COLMAP model do not hide it."""
    for layout, call in (("blender", "blender"), ("nerfstudio", "nerfstudio"), ("colmap", "colmap")):
        folder = tmp_path / layout
        write_set(layout, odd_scene, folder)
        if layout == "colmap":
            np.save(folder / "poses_bounds.npy", np.ones((3, 17)))
        init(Talk("quiet"), folder, None, False)
        config = load_scene(folder / "scene.yaml")
        assert config.dataset is not None and config.dataset.format == call


def test_a_data_set_that_moves_all_over_is_not_taken(odd_scene: Scene, tmp_path: Path) -> None:
    for layout, file in (("blender", "transforms_train.json"), ("nerfstudio", "transforms.json")):
        folder = tmp_path / layout
        write_set(layout, odd_scene, folder)
        meta = json.loads((folder / file).read_text())
        for n, entry in enumerate(meta["frames"]):
            entry["time"] = n / len(meta["frames"])
        (folder / file).write_text(json.dumps(meta))
        with refused("rest-missing", layout, "sweep", kind=InputError):
            init(Talk("quiet"), folder, None, False)
        assert not (folder / "scene.yaml").exists()


def test_clips_with_poses_of_llff_are_fixed_cameras(
    tmp_path: Path, textures: Callable[[int], np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    """Neural 3D Video: no sweep, which is said; without the poses nothing tells where the cameras are."""
    frames = [textures(0)[:240, :320].copy() for _ in range(12)]
    for n, frame in enumerate(frames):
        cv2.circle(frame, (100 + 10 * n, 100), 30, (250, 250, 250), -1)
    rows = []
    for n in range(2):
        write_video(tmp_path / f"cam{n:02d}.mp4", frames[:: 1 - 2 * n], 25.0)
        rows.append([*np.column_stack([np.eye(3), [n, 0, 0], [240, 320, 260]]).ravel(), 1.0, 5.0])
    np.save(tmp_path / "poses_bounds.npy", np.array(rows))
    init(Talk(), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.capture is not None and list(config.capture.cameras) == ["cam00", "cam01"]
    assert config.calibration.rig.given == "poses_bounds.npy" and config.capture.static is None
    assert "no sweep" in capsys.readouterr().out
    (tmp_path / "poses_bounds.npy").write_bytes(b"damaged")
    with refused("rig-without-source", tmp_path, kind=InputError):
        init(Talk(), tmp_path, None, True)
    assert "poses_bounds.npy" in capsys.readouterr().out
    with refused("count-mismatch", "cam00.mp4", "capture.cameras", kind=CaptureError):
        np.save(tmp_path / "poses_bounds.npy", np.array(rows))
        read_dataset("llff", tmp_path)


def test_a_folder_of_photos_is_a_sweep_and_a_table_gives_times(
    tmp_path: Path, textures: Callable[[int], np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    large = np.hstack([textures(0), textures(1)])
    for n in range(9):
        cv2.imwrite(str(tmp_path / f"IMG_{n}.jpg"), large[:240, 40 * n : 40 * n + 320])
    frames = [textures(0)[:240, :320].copy() for _ in range(12)]
    for n, frame in enumerate(frames):
        cv2.circle(frame, (100 + 10 * n, 100), 30, (250, 250, 250), -1)
    write_video(tmp_path / "GX010.mp4", frames, 25.0)
    write_video(tmp_path / "GX011.mp4", frames[::-1], 25.0)
    shutil.copy(tmp_path / "GX010.mp4", tmp_path / "Copy of GX010.mp4")
    rows = [f"{c},{n},{n / 25}" for c in ("GX010", "GX011") for n in range(12)]
    (tmp_path / "times.csv").write_text("camera,frame_index,time_s\n" + "\n".join(rows))
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    init(Talk(), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.capture is not None
    assert config.capture.static == "." and list(config.capture.cameras) == ["GX010", "GX011"]
    assert config.capture.timestamps == "times.csv"
    said = capsys.readouterr().out
    assert "Copy of GX010.mp4: a copy of GX010.mp4" in said
    assert "no calibration board" in said and "sound track" not in said  # the table tells the times


@pytest.mark.parametrize(
    ("files", "named"),
    [
        (("dataset.json", "camera/000.json"), "one camera"),
        (("train_meta.json", "ims/0/000000.jpg"), "ffmpeg -framerate 30"),
    ],
)
def test_public_layouts_that_are_not_read_are_named(
    tmp_path: Path, files: tuple[str, ...], named: str
) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_text("{}")
    with refused("folder-without-clips", files[0], named, kind=InputError):
        init(Talk("quiet"), tmp_path, None, False)
