"""Budgets: a run is kept within its disk and its time while it goes on."""

import shutil
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock, Mock

import pytest
from tests.pipelines.small_stages import job, small_stages, write

from devrf.calibration.sweep.static_poses import SweepOptions
from devrf.capture.system.progress import no_progress
from devrf.pipelines.budget import disk
from devrf.pipelines.budget.disk import DiskSpace, room_of, watched
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.stage import Allowance, StageContext
from devrf.pipelines.stages import static_poses
from devrf.pipelines.terminal.exit_codes import DONE, FAILED


def configured(**sections: object) -> SceneConfig:
    """A capture of a sweep and one camera."""
    capture = {"static": "s.mp4", "cameras": {"cam0": "c.mp4"}}
    return SceneConfig.model_validate({"name": "x", "capture": capture, **sections})


def room(folder: Path, disk_gb: float | None = None) -> DiskSpace:
    return room_of(configured(budget={"disk_gb": disk_gb}), folder)


def test_a_stage_is_stopped_before_the_disk_is_full(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(disk, "WATCH_S", 0.05)

    def writes(context: StageContext) -> None:
        for n in range(400):
            (context.out / f"{n}.bin").write_bytes(bytes(100_000))
            time.sleep(0.02)

    run = job(folder, small_stages(second=writes), "budget.disk_gb=0.002")
    assert execute(run) == FAILED
    said = capsys.readouterr().err
    assert said.startswith("second: ") and "budget.disk_gb is 0.002" in said and "[disk-full]" in said
    left = {p.name for p in (folder / "run").iterdir() if p.is_dir() and not p.name.startswith(".flow")}
    assert left == {"first"}
    assert sum(p.stat().st_size for p in (folder / "run").rglob("*") if p.is_file()) < 1e6
    run = job(folder, small_stages(), "budget.disk_gb=0.002")
    assert execute(run) == DONE and run.executed == ["second", "other", "third"]


def test_nothing_is_stopped_while_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk, "WATCH_S", 0.01)
    with watched(configured(budget={"disk_gb": 1.0}), tmp_path):
        time.sleep(0.1)
    found = room(tmp_path / "not" / "yet")
    assert 0 < found.count < shutil.disk_usage(tmp_path).free and "budget." not in found.bound
    (tmp_path / "large").write_bytes(bytes(2_000_000))
    found = room(tmp_path, 0.001)
    assert found.count == -1_000_000 and "budget.disk_gb is 0.001" in found.bound


def test_no_room_is_said_before_a_stage_begins(folder: Path, capsys: pytest.CaptureFixture) -> None:
    began: list[str] = []
    (folder / "run").mkdir()
    (folder / "run" / "notes.txt").write_bytes(bytes(3_000_000))
    run = job(folder, small_stages(second=lambda context: began.append("second")), "budget.disk_gb=0.002")
    assert execute(run) == FAILED and not run.executed and not began
    said = capsys.readouterr().err
    assert said.startswith("first: ") and "budget.disk_gb is 0.002" in said and "[disk-full]" in said


def test_a_run_without_time_ends_between_stages_and_goes_on(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    now, passed_s = time.monotonic, [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now() + passed_s[0])

    def slow(context: StageContext) -> None:
        assert context.allowance.left_s is not None and 0 < context.allowance.left_s <= 3600
        passed_s[0] += 3600
        write("second")(context)

    run = job(folder, small_stages(second=slow), "budget.time_minutes=60")
    assert execute(run) == FAILED and run.executed == ["first", "second"]
    said = capsys.readouterr().err
    assert "other, third (budget.time_minutes: 60)" in said and "[out-of-time]" in said
    run = job(folder, small_stages(second=slow))
    assert execute(run) == DONE and run.executed == ["other", "third"]


def test_the_film_is_left_for_later_and_the_report_is_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    now, passed_s = time.monotonic, [0.0]
    monkeypatch.setattr(time, "monotonic", lambda: now() + passed_s[0])

    def slow(context: StageContext) -> None:
        passed_s[0] += 60
        write("first")(context)

    first, second, *_ = small_stages(first=slow)
    film = replace(second, name="render", reads=())
    report = replace(second, name="report", reads=("render",))
    run = job(folder, (first, film, report), "budget.time_minutes=1")
    assert execute(run) == FAILED and run.executed == ["first", "report"]
    said = capsys.readouterr().err
    assert "render" in said and "report" not in said and "[out-of-time]" in said
    run = job(folder, (first, film, report), "budget.time_minutes=1")
    assert execute(run) == DONE and run.executed == ["render", "report"]


def test_structure_from_motion_takes_no_more_time_than_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[SweepOptions] = []

    def recover(swept: object, out: Path, options: SweepOptions, *others: object) -> None:
        asked.append(options)
        raise InterruptedError

    config = configured(calibration={"static_poses": {"mapper": "global"}})
    for name, value in (
        ("FrameSet", MagicMock()),
        ("_board", Mock(return_value=None)),
        ("Swept", Mock()),
        ("recover_sweep", recover),
    ):
        monkeypatch.setattr(static_poses, name, value)
    monkeypatch.setattr(static_poses, "swept_at_once", lambda context, sweep: (3, 960))
    for until in (time.monotonic() + 60, None):
        allowance = Allowance(until=until)
        context = StageContext(config, tmp_path, tmp_path, tmp_path, no_progress, "cpu", allowance=allowance)
        with pytest.raises(InterruptedError):
            static_poses.run(context)
    within, whenever = asked
    assert within.time_s is not None and 59 < within.time_s <= 60 and whenever.time_s is None
    assert (within.mapper, within.threads, within.side_px) == ("global", 3, 960)


def test_a_stage_knows_what_is_left_of_its_time() -> None:
    assert 59 < (Allowance(until=time.monotonic() + 60).left_s or 0) <= 60
    assert Allowance(until=time.monotonic() - 1).left_s == 0 and Allowance().left_s is None
