"""`devrf-pipeline init`: which file is what, by content before name, and what is written and said."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from devrf.calibration.boards.guess import BoardGuess, board_pictures, guess_board
from devrf.calibration.boards.spec import BoardSpec, dictionary
from devrf.calibration.field.steady import Steadiness, steadiness
from devrf.capture.errors import InputError
from devrf.capture.pictures import read_grey
from devrf.capture.survey import Look, find_material
from devrf.capture.video_writer import write_video
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.init.calibrations import given_calibration
from devrf.pipelines.init.command import init
from devrf.pipelines.init.found import Found, Roles, Seen
from devrf.pipelines.init.roles import guess_roles
from devrf.pipelines.init.summary import summary
from devrf.pipelines.init.yaml import scene_yaml

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "waving-sheet"
STANDS, MOVES, UNKNOWN = (
    Steadiness(True, 1e-4, 1.0),
    Steadiness(False, np.nan, 0.0),
    Steadiness(None, np.nan, 0.0),
)
GUESS = BoardGuess(BoardSpec("charuco", (8, 6), 1.0, 0.75, "DICT_5X5_50", False, False), 23)


# --- boards ---

BOARD_PX = 270  # length of the boards that are drawn


def board_pictures_of(image: np.ndarray, count: int = 2, background: int = 120) -> list[np.ndarray]:
    """A printed board photographed from several sides, 480x360."""
    rng = np.random.default_rng(0)
    height, width = image.shape
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    scale = BOARD_PX / max(width, height)
    out = []
    for _ in range(count):
        place = corners * scale + (90, 40) + rng.uniform(-30, 30, (4, 2))
        H = cv2.getPerspectiveTransform(corners, place.astype(np.float32))
        drawn = cv2.warpPerspective(image, H, (480, 360), flags=cv2.INTER_AREA, borderValue=background)
        out.append(cv2.GaussianBlur(drawn, (0, 0), 0.7))
    return out


def charuco(columns: int, rows: int, share: float, name: str, legacy: bool = False) -> np.ndarray:
    board = cv2.aruco.CharucoBoard((columns, rows), 1.0, share, dictionary(name))
    board.setLegacyPattern(legacy)
    return board.generateImage((100 * columns, 100 * rows), marginSize=40)


@pytest.mark.parametrize(
    ("columns", "rows", "share", "name", "legacy", "inverted"),
    [
        (8, 6, 0.75, "DICT_5X5_50", False, False),
        (5, 7, 0.7, "DICT_4X4_50", False, True),
        (6, 4, 0.75, "DICT_6X6_50", True, False),
    ],
)
def test_a_charuco_board_tells_its_layout(
    columns: int, rows: int, share: float, name: str, legacy: bool, inverted: bool
) -> None:
    image = charuco(columns, rows, share, name, legacy)
    pictures = board_pictures_of(255 - image if inverted else image)
    found = guess_board(pictures)
    assert found is not None
    spec = found.spec
    assert (spec.type, spec.squares, spec.dictionary) == ("charuco", (columns, rows), name)
    assert (spec.legacy, spec.inverted) == (legacy, inverted)
    # Each side of a marker is found to half a pixel.
    assert spec.marker_m == pytest.approx(share, abs=max(columns, rows) / BOARD_PX)
    assert board_pictures(pictures, found) == len(pictures)


def test_a_grid_of_markers_and_a_chessboard_tell_theirs() -> None:
    grid = cv2.aruco.GridBoard((5, 4), 1.0, 0.25, dictionary("DICT_4X4_50"))
    found = guess_board(board_pictures_of(grid.generateImage((600, 480), marginSize=20)))
    assert found is not None
    assert (found.spec.type, found.spec.squares) == ("aruco_grid", (5, 4))
    assert found.spec.marker_m == pytest.approx(1 / 1.25, abs=5 / BOARD_PX)

    squares = np.kron(np.indices((7, 10)).sum(0) % 2, np.ones((60, 60))) * 255
    chessboard = np.pad(squares, 60, constant_values=255).astype(np.uint8)
    found = guess_board(board_pictures_of(chessboard, background=255))
    assert found is not None
    assert (found.spec.type, found.spec.squares) == ("chessboard", (9, 6))


def test_a_room_is_no_board(textures: Callable[[int], np.ndarray]) -> None:
    assert guess_board([textures(n)[:, :, 0] for n in range(4)]) is None


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


def look(name: str, is_clip: bool = True, count: int = 100, level: float = 100.0, **more: Any) -> Look:
    picture = np.full((36, 48, 3), level, np.uint8)
    values: dict = {
        "path": Path(name), "is_clip": is_clip, "width": 1920, "height": 1080, "count": count,
        "duration_s": 4.0 if is_clip else None, "fps": 25.0 if is_clip else None, "has_audio": is_clip, "device": "",
        "created_s": None, "notes": (), "times_s": np.arange(count) / 25.0, "pictures": (picture,) * 3, "level": level,
    }  # fmt: skip
    return Look(**{**values, **more})


def seen(name: str, steady: Steadiness = STANDS, board: float = 0.0, **more: Any) -> Seen:
    return Seen(look(name, **more), name, steady, board)


def roles_of(*files: Seen) -> Roles:
    return guess_roles(files, GUESS if any(f.board_share for f in files) else None)


def test_names_of_a_camera_card_tell_nothing_and_content_decides() -> None:
    roles = roles_of(
        seen("IMG_0001.MOV", MOVES),
        seen("IMG_0002.MOV"),
        seen("IMG_0003.MOV"),
        seen("IMG_0004.MOV", board=0.9),
    )
    assert roles.sweep is not None and roles.sweep.name == "IMG_0001.MOV"
    assert list(roles.cameras) == ["IMG_0002", "IMG_0003"]
    assert "of which camera" in roles.unused["IMG_0004.MOV"]  # all have one size
    assert any("IMG_0004.MOV: taken as a board clip" in text for text in roles.doubts)


def test_a_board_clip_belongs_by_name_by_folder_or_by_size() -> None:
    roles = roles_of(
        seen("static.mp4", MOVES), seen("cam1.mp4"), seen("cam11.mp4", width=1280, height=720), seen("c/gopro.mp4"),
        seen("charuco_static.mp4", board=1.0), seen("charuco_cam1.mp4", board=1.0), seen("c/board.mp4", board=1.0),
        seen("calibration.mp4", board=1.0, width=1280, height=720),
    )  # fmt: skip
    owners = {camera: s.name for camera, s in roles.boards.items()}
    assert owners == {
        "static": "charuco_static.mp4", "cam1": "charuco_cam1.mp4", "gopro": "c/board.mp4", "cam11": "calibration.mp4",
    }  # fmt: skip


def test_the_longest_name_owns_a_board_clip() -> None:
    roles = roles_of(
        seen("static.mp4", MOVES), seen("cam.mp4"), seen("cam_b.mp4"), seen("board_cam_b.mp4", board=1.0)
    )
    assert {camera: s.name for camera, s in roles.boards.items()} == {"cam_b": "board_cam_b.mp4"}


def test_without_a_sweep_the_boards_are_joint_clips() -> None:
    roles = roles_of(seen("cam0.mp4", board=0.9), seen("cam1.mp4", board=0.8))
    assert {name: s.name for name, s in roles.joint.items()} == {"cam0": "cam0.mp4", "cam1": "cam1.mp4"}
    assert roles.sweep is None and any(text.startswith("no sweep") for text in roles.doubts)


def test_content_wins_over_names_and_what_contradicts_is_said() -> None:
    roles = roles_of(seen("static.mp4", MOVES), seen("cam0.mp4"), seen("cam1.mp4", MOVES))
    assert list(roles.cameras) == ["cam0"]
    assert "its picture moves" in roles.faulty["cam1.mp4"]
    roles = roles_of(seen("static.mp4", STANDS), seen("walk1.mp4", MOVES), seen("cam0.mp4"))
    assert roles.sweep is not None and roles.sweep.name == "walk1.mp4"
    assert "the camera stands" in roles.faulty["static.mp4"]
    roles = roles_of(seen("cam0.mp4", MOVES))
    assert any("called a fixed camera, but its picture moves" in text for text in roles.doubts)
    roles = roles_of(seen("static.mp4", MOVES), seen("cam0.mp4"), seen("board_cam0.mp4"))
    assert "no board is seen" in roles.faulty["board_cam0.mp4"]


def test_two_sweeps_black_clips_and_few_photos() -> None:
    roles = roles_of(
        seen("walk_a.mp4", MOVES, count=100), seen("walk_b.mp4", MOVES, count=300), seen("cam0.mp4", UNKNOWN),
        seen("cam1.mp4", level=2.0), seen("stills", UNKNOWN, is_clip=False, count=5),
    )  # fmt: skip
    assert roles.sweep is not None and roles.sweep.name == "walk_b.mp4"
    assert "second sweep" in roles.unused["walk_a.mp4"]
    assert roles.faulty["cam1.mp4"].startswith("black")
    assert "too few for a sweep" in roles.unused["stills"]
    assert "too little to see" in roles.why["cam0.mp4"]


def test_a_sweep_of_two_photos_cannot_be_used() -> None:
    for count, words in ((1, "1 photo:"), (2, "2 photos:")):
        roles = roles_of(seen("sweep", UNKNOWN, is_clip=False, count=count), seen("cam0.mp4"))
        assert roles.sweep is None and f"has {words}" in roles.faulty["sweep"]
    roles = roles_of(seen("sweep", UNKNOWN, is_clip=False, count=3))  # `check` refuses fewer than three
    assert roles.sweep is not None and not roles.faulty


def test_photos_of_a_board_are_no_sweep() -> None:
    roles = roles_of(
        seen("static.mp4", MOVES), seen("clips/cam1.mp4"),
        seen("intrinsics/int_cam1_img", UNKNOWN, board=0.4, is_clip=False, count=7),
        seen("photos", STANDS, board=0.9, is_clip=False, width=1280, height=720),
    )  # fmt: skip
    assert {camera: s.name for camera, s in roles.boards.items()} == {"cam1": "intrinsics/int_cam1_img"}
    assert "of which camera" in roles.unused["photos"]
    roles = roles_of(seen("photos", MOVES, board=0.9, is_clip=False))
    assert roles.sweep is not None and any("taken for the board" in text for text in roles.doubts)
    roles = roles_of(seen("static", STANDS, is_clip=False))
    assert roles.sweep is None and "stands still" in roles.faulty["static"]


def test_board_clips_are_joint_where_they_can_be() -> None:
    """Without a sweep, and where every camera has one as long as the others'."""
    cameras = [seen("cam0.mp4"), seen("cam1.mp4")]
    boards = [seen("board_cam0.mp4", board=1.0), seen("board_cam1.mp4", board=1.0)]
    assert list(roles_of(*cameras, *boards).joint) == ["cam0", "cam1"]
    assert roles_of(*cameras, *boards, seen("static.mp4", MOVES)).joint == {}
    boards[1] = seen("board_cam1.mp4", board=1.0, duration_s=9.0)  # the others: 4 s
    assert roles_of(*cameras, *boards).joint == {}
    one_sees_it = roles_of(seen("cam0.mp4", board=0.9), seen("cam1.mp4"))
    assert one_sees_it.joint == {}


POSE2SIM = (
    "[cam_{0}]\nname = 'cam{0}'\nsize = [{1}, {2}]\nmatrix = [[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], "
    "[0.0, 0.0, 1.0]]\ndistortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.{0}, 0.0]\n"
    "translation = [{0}.0, 0.0, 0.0]\nfisheye = false\n"
)  # of camera {0} in pictures {1} x {2}; lengths are in metres


def test_a_calibration_in_metres_leaves_no_scale_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    file = tmp_path / "Calib.toml"
    file.write_text("".join(POSE2SIM.format(n, 1920, 1080) for n in range(2)))
    for files, unknown in (([], True), ([file], False)):
        roles = roles_of(seen("cam0.mp4", board=0.3), seen("cam1.mp4"))  # the board lies in the scene
        given = given_calibration(tmp_path, files, roles)
        found = Found(roles, "start", None, given, False)
        summary(Talk(), tmp_path, find_material(tmp_path), found)
        assert ("size of the board's squares: unknown" in capsys.readouterr().out) is unknown
        assert ("the scale stays arbitrary" in scene_yaml("x", found)) is unknown


def test_names_become_cameras_and_the_file_is_what_run_takes(tmp_path: Path) -> None:
    cameras = ["no.mp4", "null/clip.mp4", "gopro 2/GX01.mp4", "gopro 3/GX01.mp4", "wit.mp4"]
    files = [seen("walk/a: 1.mp4", MOVES, board=0.3), *map(seen, cameras), seen("board_x.mp4")]
    roles = guess_roles(files, GUESS)
    path = tmp_path / "scene.yaml"
    path.write_text(scene_yaml("on", Found(roles, "end", None, None, False)))
    config = load_scene(path, check_files=False)
    assert config.name == "on" and config.capture is not None
    assert config.capture.static == "walk/a: 1.mp4" and config.capture.rest == "end"
    assert set(config.capture.cameras.values()) == set(cameras)
    assert "gopro_2" in config.capture.cameras
    board = config.capture.board
    assert board is not None and not board.metric and board.squares == (8, 6)


# --- the command ---


def test_the_example_without_its_scene(devrf: Callable, tmp_path: Path) -> None:
    """Every role of the example from its clips alone; the truth beside them is not read."""
    for clip in EXAMPLE.glob("*.mp4"):
        (tmp_path / clip.name).symlink_to(clip)
    result = devrf("init", tmp_path, "--name", "sheet")
    assert result.code == 0, result.said
    config, told = load_scene(tmp_path / "scene.yaml"), load_scene(EXAMPLE / "scene.yaml")
    assert config.capture is not None and told.capture is not None and told.capture.board is not None
    for key in ("static", "cameras", "test_cameras", "rest"):
        assert getattr(config.capture, key) == getattr(told.capture, key), key
    board = config.capture.board
    assert (
        board is not None
        and board.clips == told.capture.board.clips
        and board.squares == told.capture.board.squares
    )
    assert not board.metric  # nobody can see how large a square is
    assert "scale is arbitrary" in result.out and "square_m" in result.out
    again = devrf("init", tmp_path)
    assert again.code == 2 and "--force" in again.err


@pytest.mark.parametrize("content", ["empty", "stills", "broken", "moving"])
def test_a_folder_of_nothing_is_named(
    tmp_path: Path, content: str, textures: Callable[[int], np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    says = "Seen:\n  nothing"
    if content == "stills":
        for n in range(3):
            cv2.imwrite(str(tmp_path / f"{n}.jpg"), textures(n))
        says = ".: 3 of the 8 photos"
    elif content == "broken":
        (tmp_path / "cam0.mp4").write_text("This is no video.\n" * 50)
        (tmp_path / "notes.txt").write_text("take 3 is good")
        says = "cam0.mp4: not a video"
    elif content == "moving":
        write_video(tmp_path / "dark.mp4", [np.zeros((120, 160, 3), np.uint8)] * 12, 25.0)
        says = "dark.mp4: black"
    with pytest.raises(InputError, match="nothing that can be used") as error:
        init(Talk("quiet"), tmp_path, None, False)
    assert says in str(error.value)
    assert not (tmp_path / "scene.yaml").exists()


def standing_clips(folder: Path, textures: Callable[[int], np.ndarray]) -> None:
    for n in range(2):
        frames = [textures(n)[:240, :320].copy() for _ in range(8)]
        for k, frame in enumerate(frames):
            cv2.circle(frame, (60 + 20 * k, 100), 20, (250, 250, 250), -1)
        write_video(folder / f"cam{n}.mp4", frames, 25.0)


def test_fixed_cameras_alone_are_placed_by_a_calibration_or_refused(
    tmp_path: Path, textures: Callable[[int], np.ndarray], capsys: pytest.CaptureFixture
) -> None:
    standing_clips(tmp_path, textures)
    with pytest.raises(InputError, match="do not tell where the cameras are"):
        init(Talk(), tmp_path, None, False)
    assert not (tmp_path / "scene.yaml").exists()
    said = capsys.readouterr().out
    assert "fixed camera cam0" in said and "no sound track: cam0, cam1" in said and "no sweep" in said

    def calibrate(name: str, *widths: int) -> None:
        (tmp_path / name).write_text("".join(POSE2SIM.format(n, w, 240) for n, w in enumerate(widths)))

    calibrate("Calib_other.toml", 320, 400)
    with pytest.raises(InputError, match="film at the size") as error:
        init(Talk(), tmp_path, None, False)
    assert "make Calib_other.toml fit, which is there" in str(error.value) and "you own" not in str(
        error.value
    )
    assert "camera 'cam1' is calibrated at 400x240" in capsys.readouterr().out
    calibrate("Calib_rig.toml", 320, 320)
    init(Talk(), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.calibration.rig.given == "Calib_rig.toml"
    assert "Calib_other.toml: a calibration (Pose2Sim), but" in (tmp_path / "scene.yaml").read_text()


def test_a_full_disk_leaves_the_file_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "transforms_train.json").write_text("{}")
    (tmp_path / "scene.yaml").write_text("name: mine")

    def full(path: Path, text: str, **_: str) -> int:
        with path.open("w") as file:
            file.write(text[:3])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        init(Talk("quiet"), tmp_path, None, True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["scene.yaml", "transforms_train.json"]
    assert (tmp_path / "scene.yaml").read_text() == "name: mine"


def test_a_data_set_is_told(tmp_path: Path) -> None:
    (tmp_path / "transforms_train.json").write_text("{}")
    init(Talk("quiet"), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.dataset is not None and config.dataset.format == "blender"


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
    rows = [f"{c},{n},{n / 25}" for c in ("GX010", "GX011") for n in range(12)]
    (tmp_path / "times.csv").write_text("camera,frame_index,time_s\n" + "\n".join(rows))
    shutil.copy(tmp_path / "times.csv", tmp_path / "other.csv")
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    init(Talk(), tmp_path, None, False)
    config = load_scene(tmp_path / "scene.yaml")
    assert config.capture is not None
    assert config.capture.static == "." and list(config.capture.cameras) == ["GX010", "GX011"]
    assert config.capture.timestamps == "times.csv"
    said = capsys.readouterr().out
    assert "no calibration board" in said
    assert "no sound track" not in said  # the table tells the times
    assert "other.csv" not in said  # nothing says that it holds times
