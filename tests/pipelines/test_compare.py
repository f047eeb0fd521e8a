"""Comparing runs: what differs and what that is worth, what cannot be compared, and bad input."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.conftest import Command
from tests.pipelines.compare_folders import CAMERA, VIEWS, edit_metrics, set_config, write_two_runs
from tests.pipelines.report_folder import write_json
from tests.refused import refused

from devrf.capture.system.errors import InputError
from devrf.pipelines.compare.compare_command import compare, compare_runs
from devrf.pipelines.compare.compared_runs import find_runs
from devrf.pipelines.terminal.console import Talk


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the runs `one` and `two`."""
    folder = tmp_path_factory.mktemp("compare")
    write_two_runs(folder)
    return folder


@pytest.fixture
def runs(made: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "runs"))


def found_of(*folders: Path) -> dict[str, Any]:
    return compare_runs(find_runs(folders))


def by_measure(found: dict[str, Any], kind: str = "differences") -> dict[str, dict[str, Any]]:
    return {d["measure"]: d for d in found[kind]}


def test_a_difference_is_judged_over_the_same_views(made: Path) -> None:
    found = by_measure(found_of(made / "one", made / "two"))
    moving = found["test_moving.psnr"]
    assert moving["views"] == VIEWS and moving["verdict"] == "worse" and len(moving["by_pair"]) == 4
    assert moving["mean"] == pytest.approx(-1.0, abs=0.15) and abs(moving["mean"]) > moving["half"]
    assert (moving["runs"], moving["against"]) == (("two",), ("one",))
    assert found["test.ssim"]["verdict"] == "same"
    training = found["train.total_s"]
    assert training["verdict"] is None and training["half"] is None  # one number of each run


def test_what_is_within_the_scatter_cannot_be_told_apart(tmp_path: Path) -> None:
    first, second = write_two_runs(tmp_path, worse_db=0.001)
    assert by_measure(found_of(first, second))["test.psnr"]["verdict"] == "open"


def test_less_is_better_where_it_is(runs: Path) -> None:
    for run, lpips in ((runs / "one", 0.3), (runs / "two", 0.2)):
        file = run / "evaluate/metrics.json"
        metrics = json.loads(file.read_text())
        for n, row in enumerate(metrics["per_view"]):
            row["lpips_vgg"] = lpips + 0.01 * (n % 3)
        write_json(file, metrics)
    assert by_measure(found_of(runs / "one", runs / "two"))["test.lpips_vgg"]["verdict"] == "better"


def test_configuration_code_and_versions(runs: Path) -> None:
    config = {
        "reconstruct.rays": 512,
        "reconstruct.seed": 0,
        "capture.cameras.cam0": {"content": "1234567890"},
    }
    set_config(runs / "two", {"preset": "tiny", **config}, code="b")
    edit_metrics(runs / "two", versions__devrf="0.2.0", train__device="cuda")
    found = found_of(runs / "one", runs / "two")
    assert found["config"] == {
        "reconstruct.rays": ["default", "512"],
        "capture.cameras.cam0": ["–", "file 12345678"],
    }
    assert found["versions"] == {"devrf": ["0.1.0", "0.2.0"], "device of training": ["cpu", "cuda"]}
    (note,) = found["notes"]
    assert "canonical" in note and "render" not in note  # other code


def test_repeats_are_compared_seed_by_seed(runs: Path) -> None:
    """Two seeds of each of two configurations: groups are found, and paired by seed in whatever order they come."""
    folders = []
    for config, psnr in (("one", 22.75), ("two", 21.5)):
        for seed in (1, 0):
            copy = Path(shutil.copytree(runs / config, runs / f"{config}-{seed}"))
            edit_metrics(copy, seed=seed, test_moving__psnr=psnr + seed + 0.01 * seed)
            set_config(copy, {"name": config, "reconstruct.seed": seed})
            folders.append(copy)
    moving = by_measure(found_of(*folders[:2], *reversed(folders[2:])), "by_seed")["test_moving.psnr"]
    assert (moving["runs"], moving["against"]) == (("two-0", "two-1"), ("one-1", "one-0"))
    assert moving["seeds"] == (0, 1) and moving["by_pair"] == pytest.approx((-1.25, -1.25))
    assert moving["verdict"] == "worse"


def test_only_views_that_both_have_are_compared(runs: Path) -> None:
    file = runs / "two/evaluate/metrics.json"
    metrics = json.loads(file.read_text())
    write_json(file, metrics | {"per_view": metrics["per_view"][4:]})
    found = found_of(runs / "one", runs / "two")
    assert len(found["notes"]) == 1 and f"{VIEWS - 4} of {VIEWS} and {VIEWS - 4}" in found["notes"][0]
    assert by_measure(found)["test.psnr"]["views"] == VIEWS - 4


def _write_pictures(run: Path, size: tuple[int, int], change: float) -> None:
    for file in (run / "evaluate/views").glob("*/*_true.png"):
        picture = cv2.imread(str(file))
        assert picture is not None
        lighter = np.clip(picture.astype(float) + change, 0, 255).astype(np.uint8)
        cv2.imwrite(str(file), cv2.resize(lighter, size, interpolation=cv2.INTER_AREA))


def test_another_image_scale_is_said_and_not_compared(runs: Path) -> None:
    _write_pictures(runs / "two", (24, 18), 0.0)
    found = found_of(runs / "one", runs / "two")
    assert not found["differences"] and not found["by_seed"] and set(found["not_compared"]) == {"two"}


def test_other_colours_are_said(runs: Path) -> None:
    _write_pictures(runs / "two", (48, 36), 3.0)
    found = found_of(runs / "one", runs / "two")
    assert len(found["notes"]) == 1 and found["differences"]


def test_another_scene_or_other_test_cameras_are_refused(runs: Path) -> None:
    file = runs / "two/evaluate/metrics.json"
    whole = file.read_text()
    file.write_text(whole.replace(CAMERA, "other").replace('"static"', '"sweep"'))
    with refused("compare-no-common-view", "one", "two", kind=InputError):
        found_of(runs / "one", runs / "two")
    file.write_text(whole)
    for picture in (runs / "two/evaluate/views").glob("*/*_true.png"):
        cv2.imwrite(str(picture), np.zeros((36, 48, 3), np.uint8))
    with refused("compare-other-scene", "one", "two", kind=InputError):
        found_of(runs / "one", runs / "two")


@pytest.mark.parametrize(
    ("content", "refusal", "named"),
    [
        ("{", "file-damaged", "evaluate/metrics.json"),
        ("[]", "file-damaged", "evaluate/metrics.json"),
        (None, "run-unfinished", "no evaluate/metrics.json, its last finished stage is render"),
        ('{"test": {"psnr": 3}}', "metrics-without-views", "per_view"),
        ('{"per_view": [3, {"camera": []}]}', "compare-no-common-view", "two"),
    ],
)
def test_a_damaged_or_unfinished_run_is_refused(
    runs: Path, content: str | None, refusal: str, named: str
) -> None:
    file = runs / "two/evaluate/metrics.json"
    file.unlink()
    if content is not None:
        file.write_text(content)
    with refused(refusal, named, kind=InputError):
        found_of(runs / "one", runs / "two")


def test_odd_values_and_runs_of_earlier_versions_are_compared_as_far_as_they_go(runs: Path) -> None:
    edit_metrics(runs / "two", train=None, versions=None, model_mb=float("nan"), test_moving__psnr="24")
    for stage in ("rig", "flow", "evaluate"):
        # says nothing of its making
        (runs / f"two/{stage}/stamp.json").write_text('{"finished": "long ago"}')
    found = found_of(runs / "one", runs / "two")
    json.dumps(found, allow_nan=False)
    measures = found["runs"][1]["measures"]
    assert measures["model_mb"] is measures["test_moving.psnr"] is None
    assert "model_mb" not in by_measure(found)


def test_runs_in_which_nothing_moves_are_compared_on_the_held_out_pictures(runs: Path) -> None:
    for name in ("one", "two"):
        file = runs / name / "evaluate/metrics.json"
        metrics = json.loads(file.read_text())
        still = [row for row in metrics["per_view"] if row["time"] is None]
        more = [
            {**still[0], "index": 8 * n, "psnr": 24.0 + 0.1 * (n % 3) + (name == "two")} for n in range(12)
        ]
        write_json(file, metrics | {"per_view": more, "test": metrics["test_static"], "test_moving": None})
    found = found_of(runs / "one", runs / "two")
    judged = {d["measure"]: d["verdict"] for d in found["differences"] if d["views"]}
    assert judged == {"test_static.psnr": "better", "test_static.ssim": "same"}


def test_names_are_as_long_as_it_takes(made: Path, tmp_path: Path) -> None:
    for name in ("a/tiny/run", "b/tiny/run", "b/fast/run"):
        shutil.copytree(made / "one", tmp_path / name)
    named = [tmp_path / name for name in ("a/tiny/run", "b/tiny/run", "b/fast/run")]
    assert [run.name for run in find_runs(named)] == ["a/tiny", "b/tiny", "b/fast"]


def test_command(made: Path, tmp_path: Path, devrf: Command) -> None:
    out = tmp_path / "out"
    result = devrf("compare", made / "one", made / "two", "--out", out)
    assert result.code == 0, result.said
    assert "worse" in result.out and "reconstruct.rays: default | 512" in result.out
    told = json.loads((out / "compare.json").read_text())
    assert [run["name"] for run in told["runs"]] == ["one", "two"]
    assert os.listdir(out) == ["compare.json"]
    twice = devrf("compare", made / "one", made / "two", made / "one/../one", "--out", out)
    assert twice.code == 2 and "[compare-same-run]" in twice.err


def test_bad_input_is_refused_before_anything_is_written(made: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    one, two, out = made / "one", made / "two", tmp_path / "out"
    for named, where, rows, refusal, said in (
        ([one], out, None, "compare-one-run", "compare: 1 run"),
        ([one, tmp_path / "nowhere"], out, None, "run-missing", f"{tmp_path / 'nowhere'}: "),
        ([one, tmp_path / "empty"], out, None, "run-missing", f"{tmp_path / 'empty'}: "),
        ([one, two], tmp_path / "file", None, "folder-unwritable", f"--out {tmp_path / 'file'}: "),
        ([one, two], out, tmp_path, "file-is-folder", f"--json {tmp_path}: "),
    ):
        with refused(refusal, said, kind=InputError):
            compare(Talk("quiet"), named, where, rows)
    assert not out.exists()


def test_a_full_disk_is_said_and_leaves_no_half_file(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("devrf.pipelines.compare.compare_command.write_json", full)
    with refused("folder-unwritable", tmp_path, "No space left"):
        compare(Talk("quiet"), [made / "one", made / "two"], tmp_path, None)
    assert not list(tmp_path.glob("*.tmp")) and not list(tmp_path.glob(".*.tmp"))
