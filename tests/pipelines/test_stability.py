"""`bench stability`: its logic on made-up results, and two axes of a data set of 32 x 32 pictures."""

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devrf.capture.errors import DevrfError, FlowError, InputError
from devrf.capture.formats.scene_files import read_scene
from devrf.capture.simulate.dataset import simulate_dataset
from devrf.capture.simulate.dataset_options import DatasetOptions
from devrf.flow.store import read_flows
from devrf.pipelines.bench.stability.axes import AXES, GROUPS, axes_of
from devrf.pipelines.bench.stability.case import Complaint, Result, run_case
from devrf.pipelines.bench.stability.damage.intact import Damage, Intact
from devrf.pipelines.bench.stability.points import bar_db, fails, points, said
from devrf.pipelines.bench.stability.stability import run_stability
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.console import Talk
from devrf.pipelines.health.rows import Verdict
from devrf.pipelines.runner.execute import execute
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


def test_the_same_complaint_about_another_camera_is_no_new_one() -> None:
    def about(camera: str, verdict: Verdict = "warn") -> Complaint:
        return Complaint("scene", f"points in view, worst camera ({camera})", verdict, 1.0)

    shown = result(0.0, 25.0, about("cam0", "fail"), about("cam1"))
    assert said(result(1.0, 24.0, about("cam4", "fail")), shown) == ()
    softly = result(0.0, 25.0, about("cam0"))
    assert said(result(1.0, 24.0, about("cam4")), softly) == ()
    assert said(result(1.0, 24.0, about("cam4", "fail")), softly) == (
        "scene: points in view, worst camera (cam4)",
    )


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


def test_a_group_stands_for_its_axes_and_none_comes_twice() -> None:
    assert axes_of(["flow_zero", "flow"]) == ["flow_zero", "flow_wrong", "flow_noise"]
    assert set(axes_of(list(GROUPS))) == set(AXES) and not set(GROUPS) & set(AXES)


def test_where_something_else_is_filmed_its_own_scene_at_rest_is_the_bar() -> None:
    bar = bar_db(CALM)
    assert bar == 21.0
    harder = replace(result(1.0, 18.0), baseline=16.0)
    assert fails(harder, bar) and not fails(replace(harder, films_anew=True), bar)
    assert fails(replace(harder, films_anew=True, psnr_moving=16.9), bar)


def test_what_comes_back_when_the_damage_is_lessened() -> None:
    found = points([result(1.0, 24.0), result(2.0, 23.0), result(4.0, 20.0)], CALM)
    assert (found.failure, found.lessened, found.lessened_db) == (4, 2, 23)
    at_once = points([result(1.0, 20.0)], CALM)
    assert (at_once.failure, at_once.lessened, at_once.lessened_db) == (1, 0, 25)  # undamaged
    assert points([result(1.0, 24.0)], CALM).lessened is None


def test_severities_rise() -> None:
    for axis in AXES.values():
        assert list(axis.severities) == sorted(set(axis.severities)) and 3 <= len(axis.severities) <= 4


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
    assert {"stability/recall", "stability/precision", "stability/undisturbed/complaints"} <= set(rows)
    known = content["heard"]
    assert rows["stability/precision"]["value"] == known["precision"] and "Recall: of" in page
    assert (
        "pose_noise 16, seed 0" in known["spoken"]
    )  # nothing of its pictures is found again where it should be
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


@pytest.fixture
def base(suite: tuple[Path, list[str], str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """The suite's scene, with another axis that loses all flow."""

    def lose(intact: Intact) -> Damage:
        def behind(context: StageContext) -> None:
            raise FlowError("all flow is lost")

        return Damage(intact.config, "flow", behind)

    monkeypatch.setitem(AXES, "lost", replace(AXES["flow_wrong"], damaging=lose))
    scene = Path(suite[1][2])
    overrides = [f"reconstruct.{key}={value}" for key, value in SMALL.items()]
    return Run(load_scene(scene / "scene.yaml", overrides), scene, STAGES, Choice(), Talk("quiet"))


def test_a_stage_that_fails_is_a_result(suite: tuple[Path, list[str], str], base: Run) -> None:
    out = suite[0]
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


@pytest.mark.parametrize("fault", [TypeError("no such thing"), MemoryError(), OSError(errno.ENOSPC, "full")])
def test_a_fault_of_the_program_or_the_machine_is_no_result(
    suite: tuple[Path, list[str], str], base: Run, monkeypatch: pytest.MonkeyPatch, fault: Exception
) -> None:
    def behind(context: StageContext) -> None:
        raise fault

    broken = replace(AXES["flow_wrong"], damaging=lambda intact: Damage(intact.config, "flow", behind))
    monkeypatch.setitem(AXES, "broken", broken)
    with pytest.raises(DevrfError, match="broken 1, seed 0: flow: "):
        run_case(base, suite[0], "broken", 1.0, 0, read_scene(suite[0] / "undisturbed-0/seed0/run/scene"))


def test_a_folder_that_another_run_holds_is_no_result(suite: tuple[Path, list[str], str], base: Run) -> None:
    lock = Lock(suite[0] / "undisturbed-0/seed0/run")
    lock.take()
    with pytest.raises(InputError, match="another run"):
        run_case(base, suite[0], "undisturbed", 0.0, 0)
    lock.release()


def test_a_failed_run_goes_on_once_the_damage_is_gone_and_reaches_the_undisturbed_value(
    suite: tuple[Path, list[str], str], base: Run
) -> None:
    out, last = suite[0], "evaluate/metrics.json"
    calm = out / "undisturbed-0/seed0/run"
    stopped, run_dir = run_case(base, out, "lost", 1.0, 0, read_scene(calm / "scene"))
    assert stopped.stopped == "flow: all flow is lost" and not (run_dir / last).exists()
    config = base.config.model_copy(update={"output": str(run_dir)})  # and no cache to take the answer from
    mended = Run(config, base.scene_dir, STAGES, Choice(last="evaluate", allow_unhealthy=True), Talk("quiet"))
    assert execute(mended) == 0
    assert mended.executed == ["flow", "canonical", "deformation", "evaluate"]
    reached, undisturbed = (
        json.loads((folder / last).read_text())["test_moving"] for folder in (run_dir, calm)
    )
    assert reached == undisturbed


def test_no_case_begins_after_the_time_that_was_given(
    suite: tuple[Path, list[str], str], base: Run, tmp_path: Path
) -> None:
    late = tmp_path / "late.json"
    run_stability(base, suite[0], ["flow_wrong", "pose_noise"], 1, [0], late, minutes=0.0)
    content = json.loads(late.read_text())
    assert set(content["left_out"]) == {"flow_wrong", "pose_noise"} and not content["points"]
    assert "from 100 on not begun within 0 minutes" in content["left_out"]["flow_wrong"]
    assert late.with_suffix(".html").is_file()


def _file(path: Path) -> int:
    return path.stat().st_ino
