"""`devrf-pipeline check`: a healthy session is a go, and each way to bring home a useless one is named."""

import json
from collections.abc import Callable
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from tests.pipelines.tiny_scenes import tiny_scene

from devrf.calibration.boards.spec import BoardSpec, dictionary
from devrf.calibration.field.fixed import FixedGlance, glance_at_fixed
from devrf.calibration.field.matching import features
from devrf.calibration.field.steady import Steadiness, steadiness
from devrf.calibration.field.sweep import glance_at_sweep
from devrf.capture.planned import planned_frames, sweep_pictures
from devrf.capture.progress import no_progress
from devrf.capture.sampled import picture_times, read_runs, spread_starts
from devrf.capture.session import CaptureSession
from devrf.capture.survey import look_at_clip
from devrf.capture.video import VideoReader
from devrf.capture.video_writer import write_video
from devrf.pipelines.check import rows as check_rows
from devrf.pipelines.check.boards import board_rows
from devrf.pipelines.check.clocks import clock_rows
from devrf.pipelines.check.command import left_out
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.health.rows import HealthRow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "waving-sheet"
WALKS = Steadiness(False, np.nan, 0.0)


def verdict(rows: list[HealthRow], check: str) -> str:
    found = [row for row in rows if check in row.check]
    assert found, [row.check for row in rows]
    return found[0].verdict


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
    base = np.array(
        [[1.6, 0, 64], [0, 1.6, 48], [0, 0, 1]]
    )  # the picture of the straight view in the texture
    return cv2.warpPerspective(room, base @ K @ R @ np.linalg.inv(K), (320, 240), flags=cv2.WARP_INVERSE_MAP)


# --- the example ---


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
    assert result.code == 2 and "sweep.mp4: not a video" in result.err


def test_rows_that_cannot_be_written_are_refused_before_any_work(devrf: Callable, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    path = tmp_path / "file" / "rows.json"
    (tmp_path / "scene.yaml").write_text("name: x\ncapture: {static: sweep.mp4}\n")
    (tmp_path / "sweep.mp4").write_text("This is no video.")  # which would be said if it were looked into
    result = devrf("check", tmp_path, "--json", path)
    assert result.code == 2
    assert result.err.startswith(f"--json {path.parent}: ") and "not a video" not in result.err


def test_a_quiet_no_go_says_what_is_wrong(devrf: Callable, tmp_path: Path) -> None:
    write_video(tmp_path / "sweep.mp4", [np.zeros((120, 160, 3), np.uint8)] * 12, 25.0)
    (tmp_path / "scene.yaml").write_text("name: x\npreset: tiny\ncapture: {static: sweep.mp4}\n")
    result = devrf("check", tmp_path, "--quiet")
    assert result.code == 3 and result.out == "", result.said
    assert "no-go  sweep: picture of the sweep: black; Nothing was filmed" in result.err
    assert "NO-GO" in result.err and "disk" not in result.err


# --- pictures by seeking ---


def test_pictures_by_seeking_are_those_of_reading_everything(tmp_path: Path, textures: Callable) -> None:
    """A clip with several key pictures; every picture says its number in its brightness."""
    pictures = [np.full((48, 64, 3), 20 + 2 * n, np.uint8) for n in range(100)]
    path = tmp_path / "long.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=25, options={"g": "10", "bf": "2", "crf": "5"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))
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
    look = look_at_clip(path, 5)
    assert sweep_pictures(look).tolist() == list(range(100))
    frames = planned_frames(look, "camera", "long.mp4")
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


def test_a_walk_shows_depth_and_a_turn_does_not(textures: Callable) -> None:
    room, posters = textures(0), textures(1)
    walk = [features(view(room, posters, 6.0 * n)) for n in range(10)]
    rows = check_rows.sweep_rows(
        glance_at_sweep(walk, lambda n: None), WALKS, False, [str(n) for n in range(10)]
    )
    assert (
        verdict(rows, "overlap") == "ok"
        and verdict(rows, "depth") == "ok"
        and verdict(rows, "exposure") == "ok"
    )
    turn = [features(turned(room, 3.0 * n - 15)) for n in range(10)]
    rows = check_rows.sweep_rows(
        glance_at_sweep(turn, lambda n: None), WALKS, False, [str(n) for n in range(10)]
    )
    assert verdict(rows, "overlap") == "ok" and verdict(rows, "depth") == "fail"


def test_a_sweep_from_a_tripod_or_of_a_lens_cap_is_refused(textures: Callable) -> None:
    here = view(textures(0), textures(1), 20.0)
    glance = glance_at_sweep([features(here)] * 6, lambda n: None)
    steady = steadiness([here[:, :, 0]] * 6)
    rows = check_rows.sweep_rows(glance, steady, False, [str(n) for n in range(6)])
    assert verdict(rows, "movement of the sweep's camera") == "fail" and verdict(rows, "depth") == "fail"
    assert verdict(rows, "overlap") == "ok"
    rows = check_rows.sweep_rows(glance, steady, True, [str(n) for n in range(6)])
    assert [row.verdict for row in rows] == ["fail"] and "lens cap" in rows[0].remedy


def test_a_gap_is_named_unless_a_picture_between_closes_it(textures: Callable) -> None:
    room, posters = np.hstack([textures(0), textures(2)]), textures(1)
    places = [0.0, 6.0, 12.0, 700.0, 706.0, 712.0]
    walk = [features(view(room, posters, x)) for x in places]
    open_gap = glance_at_sweep(walk, lambda n: None)
    assert open_gap.breaks == (2,)
    rows = check_rows.sweep_rows(open_gap, WALKS, False, [f"{n} s" for n in range(6)])
    assert "2 s to 3 s" in next(row.remedy for row in rows if "overlap" in row.check)
    assert open_gap.linked == pytest.approx(0.8)
    far, between = [0.0, 310.0], 155.0  # of a picture 320 wide
    ends = [features(view(room, posters, x)) for x in far]
    assert glance_at_sweep(ends, lambda n: None).linked == 0.0
    assert glance_at_sweep(ends, lambda n: view(room, posters, between)).linked == 1.0


def test_exposure_that_changes_over_the_sweep(textures: Callable) -> None:
    room, posters = textures(0), textures(1)
    walk = [features(view(room, posters, 6.0 * n, light=1.0 if n < 5 else 0.6)) for n in range(10)]
    glance = glance_at_sweep(walk, lambda n: None)
    rows = check_rows.sweep_rows(glance, WALKS, False, [str(n) for n in range(10)])
    assert verdict(rows, "exposure") == "warn"
    # sRGB levels times 0.6: light changes by 0.6 ** 2.4 to 0.6 ** 2.0 (the curve is steeper where it is dark).
    assert 2.0 * np.log2(1 / 0.6) <= np.ptp(glance.light_stops[:, 1]) <= 2.4 * np.log2(1 / 0.6)


# --- fixed cameras ---


def healthy() -> dict:
    return {
        "subject_share": 0.2, "rest_share": 0.0, "shared": 500, "subject_agrees": 0.9, "rest_agrees": 0.9,
        "light_stops": 0.0, "balance": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("wrong", "check", "expected"),
    [
        ({}, "", "ok"),
        ({"subject_share": 0.0}, "something moves", "warn"),
        ({"rest_share": 0.05}, "moves at the start", "warn"),
        ({"shared": 3}, "shares with the sweep", "fail"),
        ({"shared": 50}, "shares with the sweep", "warn"),
        ({"subject_agrees": 0.5}, "against the sweep", "warn"),
        ({"light_stops": 0.4}, "exposure", "warn"),
        ({"balance": 0.1}, "white balance", "warn"),
    ],
)
def test_a_fixed_camera_is_judged(wrong: dict, check: str, expected: str, textures: Callable) -> None:
    still = steadiness([textures(0)[:, :, 0]] * 6)
    rows = check_rows.camera_rows(
        "cam1", FixedGlance(**healthy() | wrong), still, False, "start", has_sweep=True
    )
    assert verdict(rows, check) == expected
    assert [row.verdict for row in rows].count("ok") == len(rows) - (expected != "ok")
    assert all(
        "cam1" in row.remedy for row in rows if row.verdict != "ok" and "against the sweep" not in row.check
    )


def test_a_camera_that_moves_and_one_with_its_cap_on(textures: Callable) -> None:
    room = np.tile(textures(0)[:, :, 0], (1, 3))
    hand_held = steadiness([room[:, 40 * n : 40 * n + 480] for n in range(8)])
    glance = FixedGlance(**healthy())
    rows = check_rows.camera_rows("cam1", glance, hand_held, False, "start", has_sweep=True)
    assert verdict(rows, "movement of cam1") == "fail"
    rows = check_rows.camera_rows("cam1", glance, hand_held, True, "start", has_sweep=True)
    assert [row.verdict for row in rows] == ["fail"] and "lens cap" in rows[0].remedy


def test_without_a_sweep_nothing_is_asked_of_the_rest(textures: Callable) -> None:
    still = steadiness([textures(0)[:, :, 0]] * 6)
    glance = FixedGlance(**healthy() | {"rest_share": 0.2, "shared": None, "subject_agrees": None})
    rows = check_rows.camera_rows("cam1", glance, still, False, "start", has_sweep=False)
    assert {row.verdict for row in rows} == {"ok"} and not any("at the start" in row.check for row in rows)


def test_what_a_fixed_camera_shares_with_the_sweep(textures: Callable) -> None:
    """The subject is a poster that is at its place, then away from it; sweep and camera see the rest alike."""
    room, posters = textures(0), textures(1)
    sweep = [features(view(room, posters, 6.0 * n)) for n in range(8)]
    here = view(room, posters, 20.0)
    moved = here.copy()
    moved[60:200, 110:170] = here[60:200, 110:170][::-1, ::-1]
    clip = [here, here, moved, moved, here]
    good = glance_at_fixed(clip, [here] * 4, features(here), sweep)
    assert good.shared is not None and good.shared > 100
    assert good.rest_share == 0.0 and good.subject_share > 0.02
    assert good.light_stops == pytest.approx(
        0.0, abs=0.01
    )  # most of the picture is the same to the last level
    elsewhere = glance_at_fixed(clip, [here] * 4, features(textures(5)[:240, :320]), sweep)
    assert elsewhere.shared is not None and elsewhere.shared < check_rows.SHARED_FAIL


# --- clips that are left out ---


def test_a_clip_that_the_scene_does_not_name_is_said(tmp_path: Path) -> None:
    for name in ("static.mp4", "chart.mov", "cam2.mp4"):
        (tmp_path / name).touch()
    config = SceneConfig.model_validate(
        {
            "name": "x",
            "capture": {"static": "static.mp4"},
            "calibration": {"colour": {"chart": {"static": "chart.mov"}}},
        }
    )
    (found,) = left_out(config, CaptureSession(static=tmp_path / "static.mp4"), tmp_path)
    assert found.value == "cam2.mp4" and found.verdict == "ok"
    (tmp_path / "cam2.mp4").unlink()
    assert left_out(config, CaptureSession(static=tmp_path / "static.mp4"), tmp_path) == []


# --- boards ---


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
    rows = board_rows(session, spec, no_progress)
    assert [row.verdict for row in rows] == ["ok", "warn", "fail", "warn"]
    assert "never seen in the board clip of cam2" in rows[2].remedy


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
        write_video(cameras[name], [picture] * 25, 25.0)
    moving = {n: planned_frames(look_at_clip(path, 3), "camera", path.name) for n, path in cameras.items()}
    clips = {name: path.name for name, path in cameras.items()}
    config = SceneConfig.model_validate({"name": "x", "capture": {"static": "s.mp4", "cameras": clips}})
    rows = clock_rows(config, CaptureSession(cameras=cameras), moving, {})
    assert "fail" in {row.verdict for row in rows}
    assert any("clap" in row.remedy for row in rows)


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
