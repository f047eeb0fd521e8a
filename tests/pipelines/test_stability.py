"""`bench stability`: its logic on made-up results, and two axes of a data set of 32 x 32 pictures."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devrf.calibration.rigs.rig import ARBITRARY, Rig, RigCamera, read_rig, write_rig
from devrf.calibration.truth import rotation_angle_deg
from devrf.capture.errors import FlowError, InputError
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.frames import CameraFrames, FrameRecord, FrameSet
from devrf.capture.progress import no_progress
from devrf.capture.scene import Scene
from devrf.capture.simulate.dataset import simulate_dataset
from devrf.capture.simulate.dataset_options import DatasetOptions
from devrf.capture.simulate.sensor import ClipWriter
from devrf.capture.video import VideoReader
from devrf.flow.store import read_flows
from devrf.pipelines.bench.stability import damage
from devrf.pipelines.bench.stability.axes import AXES
from devrf.pipelines.bench.stability.case import Complaint, Result, run_case
from devrf.pipelines.bench.stability.damage import Damage, DoesNotApply, Intact
from devrf.pipelines.bench.stability.points import bar_db, fails, points, said
from devrf.pipelines.bench.stability.stability import run_stability
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.runner.lock import Lock
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import STAGES

SMALL = {
    "resolution": 16, "rays": 128, "canonical_iterations": 60, "motion_iterations": 10, "image_scale": 1.0,
}  # fmt: skip
SETTINGS = [part for key, value in SMALL.items() for part in ("--set", f"reconstruct.{key}={value}")]
BLUR = Complaint("ingest", "sharpness", "warn", 3.0)
LOUD = Complaint("ingest", "sharpness", "fail", 9.0)
NO_SCALE = Complaint("rig", "scale", "warn", "arbitrary scale")


def result(severity: float, psnr: float | None, *complaints: Complaint, seed: int = 0, **more: Any) -> Result:
    return Result(
        "axis", severity, seed, psnr_moving=psnr, baseline=20.0, complaints=(NO_SCALE, *complaints), **more
    )


CALM = [result(0.0, 25.0)]


def test_the_failure_point_is_where_motion_gains_less_than_it_must_over_the_undisturbed_scene_at_rest() -> (
    None
):
    assert bar_db(CALM) == 21.0
    found = points([result(1.0, 24.0), result(2.0, 20.9), result(4.0, 19.0)], CALM)
    assert (found.failure, found.notice) == (2, None)
    assert points([result(1.0, 21.0)], CALM).failure is None  # at the bar is not below it


def test_a_case_that_was_stopped_has_failed_and_has_said_so() -> None:
    found = points([result(1.0, 24.0), result(2.0, None, stopped="rig: no points")], CALM)
    assert (found.failure, found.notice) == (2, 2)
    assert found.notices == ("stopped by rig: no points",)


def test_a_row_counts_where_the_undisturbed_case_does_not_show_it_so_loudly() -> None:
    assert said(result(1.0, 24.0), CALM[0]) == ()
    assert said(result(1.0, 24.0, BLUR), CALM[0]) == ("ingest: sharpness",)
    shown = result(0.0, 25.0, BLUR)
    assert said(result(1.0, 24.0, BLUR), shown) == ()
    assert said(result(1.0, 24.0, LOUD), shown) == ("ingest: sharpness",)
    found = points([result(1.0, 24.0), result(2.0, 23.0, BLUR), result(4.0, 20.0, LOUD)], CALM)
    assert (found.failure, found.notice, found.notices) == (4, 2, ("ingest: sharpness",))


def test_half_of_the_seeds_decide() -> None:
    calm = [result(0.0, 25.0, seed=n) for n in range(4)]

    def cases(bad: int) -> list[Result]:
        return [
            result(1.0, 20.0 if n < bad else 24.0, *([BLUR] if n < bad else []), seed=n) for n in range(4)
        ]

    assert (points(cases(1), calm).failure, points(cases(1), calm).notice) == (None, None)
    assert (points(cases(2), calm).failure, points(cases(2), calm).notice) == (1, 1)


def test_where_the_undisturbed_result_is_worth_nothing_only_stops_count() -> None:
    poor = [result(0.0, 20.5)]
    assert bar_db(poor) is None
    assert not fails(result(1.0, 5.0), None)
    assert fails(result(1.0, None, stopped="flow: no"), None)


@pytest.mark.parametrize(
    ("count", "chosen"),
    [
        (None, (1.0, 2.0, 4.0, 8.0)),
        (9, (1.0, 2.0, 4.0, 8.0)),
        (3, (1.0, 2.0, 8.0)),
        (2, (2.0, 8.0)),
        (1, (8.0,)),
    ],
)
def test_some_severities_are_spread_and_hold_the_worst(count: int | None, chosen: tuple[float, ...]) -> None:
    axis = replace(AXES["seeds"], severities=(1.0, 2.0, 4.0, 8.0))
    assert axis.some(count) == chosen


def test_severities_rise() -> None:
    for axis in AXES.values():
        assert list(axis.severities) == sorted(set(axis.severities)) and 3 <= len(axis.severities) <= 4


# --- damage before the run ---

CAPTURE = """
name: sheet
preset: tiny
capture: {static: static.mp4, cameras: {cam0: a.mp4, cam1: b.mp4, cam2: c.mp4}, test_cameras: [cam1]}
"""


@pytest.fixture
def intact(tmp_path: Path, odd_scene: Scene) -> Intact:
    (tmp_path / "scene.yaml").write_text(CAPTURE)
    config = load_scene(tmp_path / "scene.yaml", check_files=False)
    return Intact(config, tmp_path, odd_scene, tmp_path, 1.0, 0)


def test_cameras_are_left_out_but_never_the_test_cameras(intact: Intact) -> None:
    assert intact.cameras == ("cam0", "cam1")  # of the scene
    config = damage.fewer_cameras(_severe(intact, 1.0)).config
    assert config.capture is not None and list(config.capture.cameras) == ["cam0", "cam1"]
    with pytest.raises(DoesNotApply, match="2 training cameras"):
        damage.fewer_cameras(_severe(intact, 2.0))


def test_keys_of_the_configuration_are_damaged(intact: Intact) -> None:
    assert damage.learning_rate(_severe(intact, 10.0)).config.reconstruct.learning_rate == 10
    seeds = {damage.other_seed(_severe(intact, n)).config.reconstruct.seed for n in (1.0, 2.0)}
    assert len(seeds) == 2 and 0 not in seeds


def test_a_sweep_of_photos_is_not_blurred(intact: Intact) -> None:
    (intact.scene_dir / "static.mp4").mkdir()
    with pytest.raises(DoesNotApply, match="folder of photos"):
        damage.blurred_sweep(intact)


def _severe(intact: Intact, severity: float) -> Intact:
    return replace(intact, severity=severity)


def test_a_thinner_sweep_has_a_thinner_truth_and_is_written_the_same_each_time(intact: Intact) -> None:
    clip = ClipWriter(intact.scene_dir / "static.mp4", (32, 16), 10.0, 17)
    for n in range(7):
        clip.picture(np.full((16, 32, 3), 30 * n, np.uint8), n / 10)
    clip.close()
    (intact.scene_dir / "ground_truth.json").write_text(json.dumps({"static": list(range(7)), "cams": {}}))
    folder = intact.folder / "case"
    folder.mkdir()
    spoilt = replace(intact, folder=folder, severity=3.0)
    config = damage.fewer_sweep_pictures(spoilt).config
    assert config.capture is not None and config.capture.static is not None
    written = Path(config.capture.static)
    before = written.read_bytes()
    with VideoReader(written) as reader:
        assert [round(frame.time_s, 3) for frame in reader] == [0.0, 0.3, 0.6]
    truth = config.truth_path(intact.scene_dir)
    assert truth is not None and json.loads(truth.read_text()) == {"static": [0, 3, 6], "cams": {}}
    damage.fewer_sweep_pictures(spoilt)
    assert written.read_bytes() == before


# --- damage behind a stage ---


def test_the_rig_is_damaged_but_not_its_test_camera(intact: Intact, tmp_path: Path) -> None:
    cameras = {f.camera_name: f.camera for f in intact.scene.dynamic}
    right = Rig({name: RigCamera(camera, "self") for name, camera in cameras.items()}, ARBITRARY)
    for damaging, severity in ((damage.turned_cameras, 2.0), (damage.wrong_focal_lengths, 10.0)):
        write_rig(tmp_path / "rig.json", right)
        done = damaging(_severe(intact, severity))
        assert done.stage == "rig"
        done.behind(_context(intact, tmp_path))
        wrong = read_rig(tmp_path / "rig.json").cameras
        assert np.array_equal(wrong["witness"].camera.cam_from_world, cameras["witness"].cam_from_world)
        for name in intact.cameras:
            turn = rotation_angle_deg(
                wrong[name].camera.cam_from_world[:, :3], cameras[name].cam_from_world[:, :3]
            )
            zoom = wrong[name].camera.K[0, 0] / cameras[name].K[0, 0]
            assert (turn, zoom) == pytest.approx((2.0, 1.0) if severity == 2.0 else (0.0, 1.1), abs=1e-4)


def test_the_last_training_cameras_clock_is_late_by_frames(intact: Intact, tmp_path: Path) -> None:
    frames = tuple(FrameRecord(n, n / 20, 100.0, True, None) for n in range(5))
    clip = CameraFrames("camera", "b.mp4", 80, 56, 20.0, False, False, None, 0, frames)
    (tmp_path / "ingest").mkdir()
    FrameSet({"cam0": clip, "cam1": clip}).write(tmp_path / "ingest")
    entry = {"offset_s": 0.5, "drift_ppm": 3.0}
    (tmp_path / "sync.json").write_text(json.dumps({"cameras": {"cam0": entry, "cam1": entry}}))
    done = damage.late_clock(_severe(intact, 2.0))
    assert done.stage == "sync"
    done.behind(_context(intact, tmp_path))
    found = json.loads((tmp_path / "sync.json").read_text())["cameras"]
    assert found == {"cam0": entry, "cam1": entry | {"offset_s": pytest.approx(0.6)}}


def _context(intact: Intact, folder: Path) -> StageContext:
    return StageContext(intact.config, intact.scene_dir, folder, folder, no_progress, "cpu")


# --- through the pipeline ---


@pytest.fixture(scope="module")
def suite(devrf: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str], str]:
    data, out = tmp_path_factory.mktemp("arm"), tmp_path_factory.mktemp("suite")
    options = DatasetOptions(
        static_views=14, static_test_views=1, times=3, test_views_per_time=1, spp=4, motion_scale=0.3
    )
    simulate_dataset(data, "arm", cameras=2, size=(32, 32), options=options)
    arguments = [
        *("bench", "stability", str(data), "--axes", "flow_wrong,pose_noise", "--severities", "1"),
        *("--out", str(out), "--device", "cpu", *SETTINGS),
    ]
    done = devrf(*arguments)
    assert done.code == 0, done.said[-2000:]
    return out, arguments, done.said


def test_the_suite_writes_rows_charts_and_a_page(suite: tuple[Path, list[str], str]) -> None:
    out, _, said_on_the_way = suite
    content = json.loads((out / "stability.json").read_text())
    rows = {row["name"]: row for row in content["rows"]}
    for case in ("undisturbed", "flow_wrong/100", "pose_noise/16"):
        assert 5 < rows[f"stability/{case}/psnr_moving"]["value"] < 60
        assert rows[f"stability/{case}/stopped"]["value"] == 0
    for axis in ("flow_wrong", "pose_noise"):
        assert f"stability/{axis}/failure point" in rows and f"stability/{axis}/notice point" in rows
        assert (out / f"stability-{axis}.png").stat().st_size > 10_000
    assert {(c["axis"], c["seed"]) for c in content["cases"]} == {
        (n, 0) for n in ("undisturbed", *content["axes"])
    }
    page = (out / "stability.html").read_text()
    assert page.count("<img") == 2 and "turned" in page
    assert "pose_noise 16, seed 0" in said_on_the_way


def test_damage_gets_in_behind_its_stage_and_what_is_before_is_shared(
    suite: tuple[Path, list[str], str],
) -> None:
    out, _, _ = suite
    calm, flow, poses = (out / f"{n}/seed0/run" for n in ("undisturbed-0", "flow_wrong-100", "pose_noise-16"))
    assert _file(calm / "scene/scene.json") == _file(flow / "scene/scene.json")  # one file in the cache
    before, after = read_flows(calm / "flow"), read_flows(flow / "flow")
    for name, right in before.items():
        wrong = after[name]
        np.testing.assert_array_equal(wrong.flow, -right.flow)
        np.testing.assert_array_equal(wrong.confidence, right.confidence)
    assert any(np.abs(right.flow).max() > 0 for right in before.values())
    right, wrong = read_scene(calm / "scene"), read_scene(poses / "scene")
    for a, b in zip(right.frames, wrong.frames, strict=True):
        same = np.allclose(a.camera.cam_from_world, b.camera.cam_from_world)
        assert same == (a.camera_name == "static" or a.split == "test")
    turns = {f.camera_name: f.camera.cam_from_world for f in wrong.dynamic if f.split == "train"}
    assert all(
        np.array_equal(f.camera.cam_from_world, turns[f.camera_name])
        for f in wrong.dynamic
        if f.split == "train"
    )


def test_a_suite_goes_on_where_it_was(devrf: Any, suite: tuple[Path, list[str], str]) -> None:
    out, arguments, _ = suite
    stamps = sorted(out.glob("*/seed0/run/*/stamp.json"))
    before = {path: path.read_text() for path in stamps}
    assert len(before) == 3 * 5  # scene, flow, canonical, deformation, evaluate
    done = devrf(*arguments)
    assert done.code == 0, done.said[-2000:]
    assert before == {path: path.read_text() for path in stamps}


def test_axes_that_do_not_exist_are_named(
    devrf: Any, suite: tuple[Path, list[str], str], tmp_path: Path
) -> None:
    _, arguments, _ = suite
    for scene in ((), (arguments[2],)):  # without one nothing is rendered first
        done = devrf("bench", "stability", *scene, "--axes", "poses", "--out", str(tmp_path / "o"))
        assert done.code == 2 and "pose_noise" in done.said
        assert not (tmp_path / "o").exists()


def test_a_scene_without_test_camera_is_refused_before_anything_runs(intact: Intact, tmp_path: Path) -> None:
    assert intact.capture is not None
    capture = intact.capture.model_copy(update={"test_cameras": ()})
    base = Run(
        intact.config.model_copy(update={"capture": capture}), tmp_path, STAGES, Choice(), Talk("quiet")
    )
    with pytest.raises(InputError, match="no test camera"):
        run_stability(base, tmp_path / "o", ["seeds"], 1, [0], tmp_path / "o/s.json")
    assert not (tmp_path / "o").exists()


def test_a_stage_that_fails_is_a_result(
    suite: tuple[Path, list[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, arguments, _ = suite

    def lose(intact: Intact) -> Damage:
        def behind(context: StageContext) -> None:
            raise FlowError("all flow is lost")

        return Damage(intact.config, "flow", behind)

    monkeypatch.setitem(AXES, "lost", replace(AXES["flow_wrong"], damaging=lose))
    scene = Path(arguments[2])
    overrides = [f"reconstruct.{key}={value}" for key, value in SMALL.items()]
    base = Run(load_scene(scene / "scene.yaml", overrides), scene, STAGES, Choice(), Talk("quiet"))
    undisturbed = read_scene(out / "undisturbed-0/seed0/run/scene")
    whole, run_dir = run_case(base, out, "flow_wrong", 100.0, 0, undisturbed)
    (out / "lost-100/seed0").mkdir(parents=True)
    shutil.copytree(run_dir, out / "lost-100/seed0/run")  # as if it had once gone through
    stopped, _ = run_case(base, out, "lost", 100.0, 0, undisturbed)
    assert stopped.stopped == "flow: all flow is lost" and stopped.psnr is None
    assert "deformation" in {c.stage for c in whole.complaints}
    assert {c.stage for c in stopped.complaints} <= {"scene"}
    assert stopped.seconds < whole.seconds
    assert points([stopped], CALM).failure == 100
    log = (out / "lost-100/seed0/run/devrf.log").read_text()
    assert "ERROR" in log and "all flow is lost" in log


def test_a_folder_that_another_run_holds_is_no_result(
    suite: tuple[Path, list[str], str],
) -> None:
    out, arguments, _ = suite
    scene = Path(arguments[2])
    base = Run(load_scene(scene / "scene.yaml"), scene, STAGES, Choice(), Talk("quiet"))
    lock = Lock(out / "undisturbed-0/seed0/run")
    lock.take()
    with pytest.raises(InputError, match="another run"):
        run_case(base, out, "undisturbed", 0.0, 0)
    lock.release()


def _file(path: Path) -> int:
    return path.stat().st_ino
