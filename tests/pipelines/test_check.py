"""`devrf-pipeline check`: a healthy session is a go, and each way to bring home a useless one is named."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.make.clips import film
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.calibration.boards.spec import BoardSpec, dictionary
from devrf.calibration.preview.matching import features
from devrf.calibration.preview.overlap import overlap_of
from devrf.capture.ingest.survey import Footage, look_at
from devrf.capture.photos.upright_pictures import write_picture
from devrf.capture.rest import Rest
from devrf.capture.session import CaptureSession
from devrf.capture.system.progress import no_progress
from devrf.capture.video.reader import VideoReader
from devrf.capture.video.sampled import picture_times, read_runs, spread_starts
from devrf.capture.video.video_writer import write_video
from devrf.pipelines.check.board_pictures import board_measures
from devrf.pipelines.check.check_command import WORDS, left_out
from devrf.pipelines.check.clip_pictures import camera_measures, planned_frames, see_sweep
from devrf.pipelines.check.clock_preview import clock_measures
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.judge import judge

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "workshop"


def view(room: np.ndarray, objects: np.ndarray, x: float, light: float = 1.0) -> np.ndarray:
    """A wall and three posters before it, four times nearer, from a place at x: 320x240."""
    far = cv2.warpAffine(room, np.array([[1.0, 0, -x], [0, 1, -100]]), (320, 240))
    for n in range(3):
        left = round(60 + 130 * n - 4 * x)
        for column in range(max(0, left), min(320, left + 60)):
            far[60:200, column] = objects[60:200, (column - left + 150 * n) % 640]
    return np.clip(far * light, 0, 255).astype(np.uint8)


def turned(room: np.ndarray, degrees: float) -> np.ndarray:
    """The room from one place, the camera turned: 320x240, 60 degrees wide."""
    K = np.array([[277.0, 0, 160], [0, 277, 120], [0, 0, 1]])
    R = cv2.Rodrigues(np.array([0.0, np.radians(degrees), 0.0]))[0]
    # the picture of the straight view in the texture
    base = np.array([[1.6, 0, 64], [0, 1.6, 48], [0, 0, 1]])
    return cv2.warpPerspective(room, base @ K @ R @ np.linalg.inv(K), (320, 240), flags=cv2.WARP_INVERSE_MAP)


# --- the example ---


@pytest.mark.full
def test_the_example_is_a_go(devrf: Callable, tmp_path: Path) -> None:
    result = devrf(
        "check", EXAMPLE, "--set", f"output={tmp_path / 'run'}", "--json", tmp_path / "new" / "rows.json"
    )
    assert result.code == 0, result.said
    found = json.loads((tmp_path / "new" / "rows.json").read_text())
    assert found["go"] and {row["verdict"] for row in found["rows"]} == {"ok"}
    assert {"sweep", "camera cam0", "camera witness", "all cameras", "clocks", "board"} < {
        row["about"] for row in found["rows"]
    }
    assert found["seconds"] > 0
    assert not (tmp_path / "run").exists()
    assert "GO" in result.out


def test_what_cannot_be_read_is_bad_input(devrf: Callable, tmp_path: Path) -> None:
    (tmp_path / "sweep.mp4").write_text("This is no video.\n" * 50)
    (tmp_path / "scene.yaml").write_text("name: x\ncapture: {static: sweep.mp4}\n")
    result = devrf("check", tmp_path)
    assert result.code == 2 and "sweep.mp4: " in result.err and "[inputs-unusable]" in result.err


def test_rows_that_cannot_be_written_are_refused_before_any_work(devrf: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "rows.json"
    (tmp_path / "scene.yaml").write_text("name: x\ncapture: {static: sweep.mp4}\n")
    (tmp_path / "sweep.mp4").write_text("This is no video.")  # which would be said if it were looked into
    result = devrf("check", tmp_path, "--json", path)
    assert result.code == 2
    assert result.err.startswith(f"--json {path.parent}: ") and "sweep.mp4" not in result.err


def test_a_quiet_no_go_says_what_is_wrong(devrf: Callable, tmp_path: Path) -> None:
    write_video(tmp_path / "sweep.mp4", [np.zeros((120, 160, 3), np.uint8)] * 12, 25.0)
    (tmp_path / "scene.yaml").write_text("name: x\npreset: tiny\ncapture: {static: sweep.mp4}\n")
    result = devrf("check", tmp_path, "--quiet")
    assert result.code == 3 and result.out == "", result.said
    assert re.search(rf"{WORDS['fail']}  sweep: .*black; .*\[check-failed\]", result.err)
    assert "[check-no-go]" in result.err and "disk" not in result.err


# --- pictures by seeking ---


def test_pictures_by_seeking_are_those_of_reading_everything(tmp_path: Path, textures: Callable) -> None:
    """A clip with several key pictures; every picture says its number in its brightness."""
    pictures = [np.full((48, 64, 3), 20 + 2 * n, np.uint8) for n in range(100)]
    path = film(tmp_path / "long.mp4", pictures, g="10", bf="2", crf="5")
    times = picture_times(path)
    with VideoReader(path) as reader:
        whole = {frame.index: (frame.time_s, float(frame.rgb.mean())) for frame in reader}
    np.testing.assert_allclose(times, [time_s for time_s, _ in whole.values()])
    runs = list(read_runs(path, times, spread_starts(times, 7, 3), 3))
    assert [run[0].index for run in runs] == [0, 16, 32, 48, 65, 81, 97]
    for frame in (frame for run in runs for frame in run):
        time_s, level = whole[frame.index]
        assert frame.time_s == pytest.approx(time_s)
        assert frame.rgb.mean() == pytest.approx(level, abs=0.5)  # the numbers are 2 levels apart
    frames = planned_frames(look_at(path, 5), "camera", "long.mp4")
    assert len(frames.used) == 100 and frames.fps_mean == pytest.approx(25.0)


def test_a_damaged_clip_gives_what_decodes(tmp_path: Path, textures: Callable) -> None:
    path = tmp_path / "cut.mp4"
    write_video(path, [textures(n)[:240, :320] for n in range(12)], 25.0)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 2 // 3])
    times = picture_times(path)
    runs = list(read_runs(path, times, spread_starts(times, 12)))
    assert 3 <= sum(map(bool, runs)) <= 12


# --- sweeps ---


def clip(path: Path, pictures: list[np.ndarray]) -> Footage:
    write_video(path, pictures, 25.0)
    return look_at(path, 12)


def sweep_verdicts(path: Path, pictures: list[np.ndarray]) -> dict[str, str]:
    """The worst verdict of each code."""
    seen = see_sweep(clip(path, pictures), no_progress)
    assert len(seen.frames.used) == len(pictures)
    rows = sorted(judge(seen.measures), key=lambda row: row.verdict == "fail")
    return {row.code: row.verdict for row in rows}


def test_a_walk_shows_depth_and_a_turn_a_tripod_and_a_lens_cap_do_not(
    tmp_path: Path, textures: Callable
) -> None:
    room, posters = textures(0), textures(1)
    walk = [view(room, posters, 6.0 * n) for n in range(10)]
    assert sweep_verdicts(tmp_path / "walk.mp4", walk) == {"sweep-overlap": "ok", "sweep-depth": "ok"}
    turn = [turned(room, 3.0 * n - 15) for n in range(10)]
    assert sweep_verdicts(tmp_path / "turn.mp4", turn) == {"sweep-overlap": "ok", "sweep-depth": "fail"}
    stood = sweep_verdicts(tmp_path / "stood.mp4", [view(room, posters, 20.0)] * 6)
    assert stood == {"sweep-overlap": "ok", "sweep-depth": "fail"}
    assert sweep_verdicts(tmp_path / "cap.mp4", [np.zeros_like(walk[0])] * 6) == {"sweep-blurred": "fail"}


def test_copies_of_photos_count_once(tmp_path: Path, textures: Callable) -> None:
    for n in range(6):
        write_picture(tmp_path / f"IMG_{n}.jpg", textures(n)[:120, :160])
        if n % 2:
            shutil.copy(tmp_path / f"IMG_{n}.jpg", tmp_path / f"Copy of IMG_{n}.jpg")
    frames = planned_frames(look_at(tmp_path, 4), "sweep", "in")
    assert len(frames.used) == 6 and any("3 of them are copies" in note for note in frames.notes)


def test_a_gap_is_named_unless_a_picture_between_closes_it(textures: Callable) -> None:
    room, posters = np.hstack([textures(0), textures(2)]), textures(1)
    walk = [features(view(room, posters, x)) for x in (0.0, 6.0, 12.0, 700.0, 706.0, 712.0)]
    open_gap = overlap_of(walk, lambda n: None)
    assert open_gap.breaks == (2,) and open_gap.linked == pytest.approx(0.8)
    ends = [features(view(room, posters, x)) for x in (0.0, 310.0)]  # of a picture 320 wide
    assert overlap_of(ends, lambda n: None).linked == 0.0
    assert overlap_of(ends, lambda n: view(room, posters, 155.0)).linked == 1.0


# --- fixed cameras ---


def test_a_fixed_camera_is_judged(tmp_path: Path, textures: Callable) -> None:
    """Its subject is a poster that leaves its place; it stands, is bumped, sees nothing move, or another room."""
    room, posters = textures(0), textures(1)
    sweep = [features(view(room, posters, 6.0 * n)) for n in range(8)]
    here = view(room, posters, 20.0)
    moved = here.copy()
    moved[60:200, 110:170] = here[60:200, 110:170][::-1, ::-1]
    elsewhere = textures(5)[:240, :320]

    def verdicts(
        name: str, pictures: list[np.ndarray], rest: Rest = "start", sees: list = sweep
    ) -> list[str]:
        """Of movement, subject, rest, overlap with the sweep."""
        look = clip(tmp_path / f"{name}.mp4", pictures)
        return [row.verdict for row in judge(camera_measures("cam1", look, rest, sees))]

    clips = {"good": [here] * 6 + [moved] * 12, "early": [here, here, moved, moved] * 5, "still": [here] * 12}
    assert verdicts("good", clips["good"]) == ["ok", "ok", "ok", "ok"]
    assert verdicts("early", clips["early"]) == ["ok", "ok", "warn", "ok"]
    assert verdicts("still", clips["still"]) == ["ok", "warn", "ok", "ok"]
    assert verdicts("early", clips["early"], "none") == ["ok", "ok", "ok"]
    # without a sweep nothing is asked of the rest
    assert verdicts("early", clips["early"], sees=[]) == ["ok", "ok"]
    assert verdicts("elsewhere", [elsewhere] * 12)[-1] == "fail"
    wide = np.tile(room, (1, 3, 1))
    assert verdicts("hand", [wide[:, 40 * n : 40 * n + 480] for n in range(12)])[0] == "fail"
    assert verdicts("cap", [np.zeros_like(here)] * 6) == ["fail"]


# --- clips that are left out ---


def test_a_clip_that_the_scene_does_not_name_is_said(tmp_path: Path) -> None:
    for name in ("static.mp4", "cam2.mp4"):
        (tmp_path / name).touch()
    (row,) = judge(left_out(CaptureSession(static=tmp_path / "static.mp4"), tmp_path))
    assert str(row.value).endswith(": cam2.mp4") and row.verdict == "ok"
    (tmp_path / "cam2.mp4").unlink()
    assert left_out(CaptureSession(static=tmp_path / "static.mp4"), tmp_path) == []


# --- boards ---


@pytest.mark.full
def test_a_board_clip_without_its_board_is_a_no_go(tmp_path: Path, textures: Callable) -> None:
    """One clip shows the board in half of its pictures, one in few, one never; never is no failure of a joint clip."""
    image = charuco_picture()
    spec = BoardSpec("charuco", (5, 4), 0.06, 0.045, "DICT_4X4_50", False, False)
    paths = {}
    for name, every in (("cam0", 2), ("cam1", 6), ("cam2", 0)):
        pictures = [image if every and n % every == 0 else textures(0)[:240, :320] for n in range(24)]
        paths[name] = tmp_path / f"{name}.mp4"
        write_video(paths[name], pictures, 25.0)
    session = CaptureSession(board_clips=paths, joint_clips={"cam2": paths["cam2"]})
    rows = judge(board_measures(session, spec, no_progress))
    assert [row.verdict for row in rows] == ["ok", "warn", "fail", "warn"]
    assert rows[2].value == rows[3].value == "never"
    assert [row.about for row in rows] == ["cam0", "cam1", "cam2", "cam2"]


def charuco_picture() -> np.ndarray:
    board = cv2.aruco.CharucoBoard((5, 4), 0.06, 0.045, dictionary("DICT_4X4_50"))
    grey = cv2.copyMakeBorder(board.generateImage((250, 200)), 20, 20, 35, 35, cv2.BORDER_CONSTANT, value=255)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)


# --- clocks, disk ---


def test_silent_clips_in_which_nothing_moves_have_no_clock(tmp_path: Path, textures: Callable) -> None:
    picture = textures(0)[:120, :160]
    cameras = {}
    for name in ("cam0", "cam1"):
        cameras[name] = tmp_path / f"{name}.mp4"
        lossless = {"qp": "0"}  # or what the encoder improves would move in both
        write_video(cameras[name], [picture] * 25, 25.0, lossless)
    moving = {n: planned_frames(look_at(path, 3), "camera", path.name) for n, path in cameras.items()}
    clips = {name: path.name for name, path in cameras.items()}
    config = SceneConfig.model_validate({"name": "x", "capture": {"static": "s.mp4", "cameras": clips}})
    rows = judge(clock_measures(config, CaptureSession(cameras=cameras), moving, {}))
    assert any(row.verdict == "fail" and row.code == "clock-unknown" for row in rows)


@pytest.mark.parametrize("disk_gb", [None, 0.001])
def test_no_room_for_the_run_folder_is_a_no_go(
    devrf: Callable, tmp_path: Path, disk_gb: float | None
) -> None:
    scene, rows = tiny_scene(tmp_path, "ball"), tmp_path / "rows.json"
    (scene.parent / "run").mkdir()
    (scene.parent / "run" / "large").write_bytes(bytes(2_000_000))
    said = [] if disk_gb is None else ["--set", f"budget.disk_gb={disk_gb}"]
    checked = devrf("check", scene, "--json", rows, *said)
    room, memory = (row for row in json.loads(rows.read_text())["rows"] if row["about"] != "files")
    assert (checked.code, room["verdict"], memory["verdict"]) == (
        3 if said else 0,
        "fail" if said else "ok",
        "ok",
    )
    assert not said or (room["value"] == pytest.approx(-0.001) and "budget.disk_gb" in room["remedy"])
