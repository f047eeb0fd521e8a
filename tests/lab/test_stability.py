"""`bench stability` through the pipeline: two axes of a data set of 32 x 32 pictures."""

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.lab.conftest import SETTINGS, SMALL
from tests.refused import refused

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.system.errors import FlowError, InputError
from devrf.flow.store import read_flows
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.case import run_case
from devrf.lab.bench.stability.damage.intact import Damage, Intact
from devrf.lab.bench.stability.points import points
from devrf.lab.bench.stability.suite import Extent, run_stability
from devrf.pipelines.config.load import load_scene
from devrf.pipelines.health.judge import entries
from devrf.pipelines.run_folder.lock import Lock
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import StageContext
from devrf.pipelines.stages import STAGES
from devrf.pipelines.terminal.console import Talk

pytestmark = pytest.mark.full  # whole runs; what the suite is made of has tests of its own

Suite = tuple[Path, list[str], str]


@pytest.fixture(scope="module")
def suite(devrf: Any, arm: Path, tmp_path_factory: pytest.TempPathFactory) -> Suite:
    out = tmp_path_factory.mktemp("suite")
    arguments = [
        *("bench", "stability", str(arm), "--axes", "flow_wrong,pose_noise", "--severities", "1"),
        *("--out", str(out), "--device", "cpu", *SETTINGS),
    ]
    done = devrf(*arguments)
    assert done.code == 0, done.said[-2000:]
    return out, arguments, done.said


def test_the_suite_writes_rows_and_a_chart(suite: Suite) -> None:
    out, _, said_on_the_way = suite
    content = json.loads((out / "stability.json").read_text())
    rows = {row["name"]: row for row in content["rows"]}
    for case in ("undisturbed", "flow_wrong/100", "pose_noise/16"):
        assert 5 < rows[f"stability/{case}/psnr_moving"]["value"] < 60
        assert rows[f"stability/{case}/stopped"]["value"] == 0
    for axis in ("flow_wrong", "pose_noise"):
        assert f"stability/{axis}/failure point" in rows and f"stability/{axis}/notice point" in rows
    assert {(c["axis"], c["seed"]) for c in content["cases"]} == {
        (n, 0) for n in ("undisturbed", *content["axes"])
    }
    codes = {c["code"] for case in content["cases"] for c in case["complaints"]}
    assert codes and codes <= entries().keys()
    assert (out / "stability.png").stat().st_size > 10_000
    assert {"stability/recall", "stability/precision", "stability/undisturbed/complaints"} <= set(rows)
    known = content["heard"]
    assert rows["stability/precision"]["value"] == known["precision"]
    assert "pose_noise 16, seed 0" in known["spoken"]  # nothing is found again where it should be
    assert "pose_noise 16, seed 0" in said_on_the_way


def test_damage_gets_in_behind_its_stage_and_what_is_before_is_shared(suite: Suite) -> None:
    out, _, _ = suite
    calm, flow, poses = (out / f"{n}/seed0/run" for n in ("undisturbed-0", "flow_wrong-100", "pose_noise-16"))
    assert _file(calm / "scene/scene.json") == _file(flow / "scene/scene.json")  # one file, linked
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


def test_a_suite_goes_on_where_it_was(devrf: Any, suite: Suite) -> None:
    out, arguments, _ = suite
    stamps = sorted(out.glob("*/seed0/run/*/stamp.json"))
    before = {path: path.read_text() for path in stamps}
    assert len(before) == 3 * 5  # scene, flow, canonical, deformation, evaluate
    done = devrf(*arguments)
    assert done.code == 0, done.said[-2000:]
    assert before == {path: path.read_text() for path in stamps}


def test_methods_stand_side_by_side(devrf: Any, arm: Path, tmp_path: Path) -> None:
    arguments = [
        *("bench", "stability", str(arm), "--axes", "pose_noise,learning_rate", "--severities", "1"),
        *(
            "--methods",
            "d-nerf,k-planes",
            "--seconds",
            "1",
            "--out",
            str(tmp_path),
            "--device",
            "cpu",
            *SETTINGS,
        ),
    ]
    done = devrf(*arguments)
    assert done.code == 0, done.said[-2000:]
    content = json.loads((tmp_path / "stability.json").read_text())
    rows = {row["name"]: row for row in content["rows"]}
    for name in ("d-nerf", "k-planes"):
        for case in ("undisturbed", "pose_noise/16"):
            assert 5 < rows[f"stability/{name}/{case}/psnr_moving"]["value"] < 60
        assert f"stability/{name}/pose_noise/failure point" in rows
    assert "DeVRF alone" in content["left_out"]["learning_rate"] and list(content["axes"]) == ["pose_noise"]
    assert (tmp_path / "stability.png").stat().st_size > 10_000
    trained = {
        path: path.stat().st_mtime_ns for path in tmp_path.glob("*/seed0/methods/seed0/*/metrics.json")
    }
    assert len(trained) == 4
    assert devrf(*arguments).code == 0
    assert trained == {path: path.stat().st_mtime_ns for path in trained}


def test_methods_that_do_not_exist_are_named(devrf: Any, arm: Path, tmp_path: Path) -> None:
    scene = ("bench", "stability", str(arm), "--axes", "pose_noise", "--out", str(tmp_path / "o"))
    done = devrf(*scene, "--methods", "nerf")
    assert done.code == 2 and "d-nerf" in done.said and not (tmp_path / "o").exists()


def test_axes_that_do_not_exist_are_named(devrf: Any, arm: Path, tmp_path: Path) -> None:
    for scene in ((), (str(arm),)):  # without one nothing is rendered first
        done = devrf("bench", "stability", *scene, "--axes", "poses", "--out", str(tmp_path / "o"))
        assert done.code == 2 and "pose_noise" in done.said
        assert not (tmp_path / "o").exists()


@pytest.fixture
def base(suite: Suite, monkeypatch: pytest.MonkeyPatch) -> Run:
    """The suite's scene, with another axis that loses all flow."""

    def lose(intact: Intact) -> Damage:
        def behind(context: StageContext) -> None:
            raise FlowError("flow-lost", "all flow is lost")

        return Damage(intact.config, "flow", behind)

    monkeypatch.setitem(AXES, "lost", replace(AXES["flow_wrong"], damaging=lose))
    scene = Path(suite[1][2])
    overrides = [f"reconstruct.{key}={value}" for key, value in SMALL.items()]
    return Run(load_scene(scene / "scene.yaml", overrides), scene, STAGES, Choice(), Talk("quiet"))


def test_a_stage_that_fails_is_a_result(suite: Suite, base: Run) -> None:
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
    assert points([stopped], [whole]).failure == 100
    log = (out / "lost-100/seed0/run/devrf.log").read_text()
    assert "ERROR" in log and "all flow is lost" in log


@pytest.mark.parametrize(
    ("fault", "refusal"),
    [
        (TypeError("no such thing"), "unexpected"),
        (MemoryError(), "no-memory"),
        (OSError(errno.ENOSPC, "full"), "disk-full"),
    ],
)
def test_a_fault_of_the_program_or_the_machine_is_no_result(
    suite: Suite, base: Run, monkeypatch: pytest.MonkeyPatch, fault: Exception, refusal: str
) -> None:
    def behind(context: StageContext) -> None:
        raise fault

    broken = replace(AXES["flow_wrong"], damaging=lambda intact: Damage(intact.config, "flow", behind))
    monkeypatch.setitem(AXES, "broken", broken)
    with refused(refusal, "broken 1, seed 0: flow: "):
        run_case(base, suite[0], "broken", 1.0, 0, read_scene(suite[0] / "undisturbed-0/seed0/run/scene"))


def test_a_folder_that_another_run_holds_is_no_result(suite: Suite, base: Run) -> None:
    lock = Lock(suite[0] / "undisturbed-0/seed0/run")
    lock.take()
    with refused("folder-busy", suite[0], kind=InputError):
        run_case(base, suite[0], "undisturbed", 0.0, 0)
    lock.release()


def test_a_failed_run_goes_on_once_the_damage_is_gone_and_reaches_the_undisturbed_value(
    suite: Suite, base: Run
) -> None:
    out, last = suite[0], "evaluate/metrics.json"
    calm = out / "undisturbed-0/seed0/run"
    stopped, run_dir = run_case(base, out, "lost", 1.0, 0, read_scene(calm / "scene"))
    assert stopped.stopped == "flow: all flow is lost" and not (run_dir / last).exists()
    config = base.config.model_copy(update={"output": str(run_dir)})
    mended = Run(config, base.scene_dir, STAGES, Choice(last="evaluate", allow_unhealthy=True), Talk("quiet"))
    assert execute(mended) == 0
    assert mended.executed == ["flow", "deformation", "evaluate"]
    reached, undisturbed = (
        json.loads((folder / last).read_text())["test_moving"] for folder in (run_dir, calm)
    )
    assert reached == undisturbed


def test_no_case_begins_after_the_time_that_was_given(
    suite: Suite, base: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = tmp_path / "late.json"
    moment = SimpleNamespace(monotonic=lambda: 7.0)  # a clock too coarse to tell what went by
    monkeypatch.setattr("devrf.lab.bench.stability.suite.time", moment)
    run_stability(base, suite[0], ["flow_wrong", "pose_noise", "box_size"], Extent(2, [0], 0.0), late)
    content = json.loads(late.read_text())
    assert set(content["left_out"]) == {"flow_wrong", "pose_noise", "box_size"}
    assert "from 30 on nothing was begun after 0 minutes" in content["left_out"]["flow_wrong"]
    made = {(case["axis"], case["severity"]) for case in content["cases"]}
    assert made == {("undisturbed", 0.0), ("flow_wrong", 100.0), ("pose_noise", 16.0)}  # of the earlier run
    assert late.with_suffix(".png").is_file()


def _file(path: Path) -> int:
    return path.stat().st_ino
