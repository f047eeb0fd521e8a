"""Batches on the local pool, with real stages on tiny scenes: what runs, what is refused, what the summary says."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.conftest import Command
from tests.pipelines.tiny_scenes import tiny_scene
from tests.refused import refused
from tests.waiting import wait_for

from devrf.capture.system.errors import InputError
from devrf.pipelines.batch import batch_command as command
from devrf.pipelines.batch import scenes
from devrf.pipelines.batch import task as batch_task
from devrf.pipelines.batch.scene_rows import STOPPED_MESSAGE
from devrf.pipelines.batch.scenes import BatchOptions, look, stand
from devrf.pipelines.batch.task import Task, run_task
from devrf.pipelines.run_folder.workspace import Workspace
from devrf.pipelines.runner.standing import Standing
from devrf.pipelines.stages import STAGES
from devrf.pipelines.stamps import digests
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED

LONG = 100_000  # iterations: it will not come to its end


def summary(out: Path) -> dict[str, Any]:
    return json.loads((out / "batch.json").read_text())


def by_name(out: Path) -> dict[str, dict[str, Any]]:
    return {row["name"]: row for row in summary(out)["scenes"]}


@pytest.fixture(scope="module")
def whole(devrf: Command, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes run to their reports, a third that stops short of it, and a fourth with a mistake in it."""
    folder = tmp_path_factory.mktemp("batch")
    for name in ("a", "b"):
        tiny_scene(folder, name)
    broken = tiny_scene(folder, "broken")
    (broken.parent / "data/train/r_3.png").write_bytes(b"no picture")
    typo = tiny_scene(folder, "typo")
    typo.write_text(typo.read_text().replace("resolution", "resolutoin"))
    scenes = [folder / name for name in ("a", "b", "broken", "typo")]
    result = devrf("batch", *scenes, "--device", "cpu", "--jobs", "2", "--out", folder / "out")
    assert result.code == BAD_INPUT, result.said
    (folder / "said").write_text(result.said)
    return folder


@pytest.mark.full
def test_a_bad_scene_stops_no_other(whole: Path) -> None:
    rows = by_name(whole / "out")
    assert {name: row["state"] for name, row in rows.items()} == {
        "a": "done",
        "b": "done",
        "broken": "refused",
        "typo": "refused",
    }
    assert "resolution?" in rows["typo"]["message"]
    assert "r_3.png" in rows["broken"]["message"]
    assert not (whole / "broken/run").exists()  # seen before anything was started


@pytest.mark.full
def test_the_summary_says_what_the_stages_left(whole: Path) -> None:
    batch = summary(whole / "out")
    assert batch["finished"] and batch["code"] == BAD_INPUT
    assert batch["states"] == {"done": 2, "refused": 2}
    row = by_name(whole / "out")["a"]
    assert list(row["stages"]) == ["scene", "canonical", "evaluate", "render", "report"] == row["made"]
    stamp = json.loads((whole / "a/run/canonical/stamp.json").read_text())
    assert row["stages"]["canonical"]["seconds"] == stamp["seconds"]
    measured = json.loads((whole / "a/run/evaluate/metrics.json").read_text())
    assert row["numbers"]["psnr"] == measured["test"]["psnr"]
    assert row["nodes"] == [os.uname().nodename] and row["seconds"] > stamp["seconds"]
    assert Path(row["report"]) == whole / "a/run/report/index.html"


@pytest.mark.full
def test_a_rerun_does_only_what_is_missing(whole: Path, devrf: Command) -> None:
    ids = {p: p.read_text() for p in whole.glob("*/run/*/stamp.json")}
    again = ("--device", "cpu", "--out", whole / "again")
    result = devrf("batch", whole / "a", whole / "b", *again)
    assert result.code == DONE and "nothing to do" in result.said
    assert all(row["made"] == [] for row in summary(whole / "again")["scenes"])
    assert {p: p.read_text() for p in whole.glob("*/run/*/stamp.json")} == ids
    (whole / "b/run/report/index.html").unlink()
    assert devrf("batch", whole / "a", whole / "b", *again).code == DONE
    assert {name: row["made"] for name, row in by_name(whole / "again").items()} == {"a": [], "b": ["report"]}


@pytest.mark.full
def test_the_files_of_a_fresh_scene_are_not_opened(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its stamps tell all there is to know: a batch of which most is done begins at once."""

    def opened(*arguments: object) -> None:
        raise InputError("looked-at", "looked at")

    monkeypatch.setattr(scenes, "check_inputs", opened)
    monkeypatch.setattr(scenes, "check_folder", opened)
    options = BatchOptions()
    (scene,) = look([whole / "a"], options)
    stand(scene)
    assert scene.to_do == [] and len(scene.stages) == 5 and scene.problem is None
    (scene,) = look([whole / "a"], BatchOptions(overrides=("output=empty",)))
    stand(scene)
    assert scene.problem == "looked at"


def test_what_a_look_has_read_nobody_reads_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny_scene(tmp_path, "a")
    read: list[Path] = []
    entry = digests._entry
    monkeypatch.setattr(digests, "RACY_S", 0.0)  # the files were only just written
    monkeypatch.setattr(digests, "_entry", lambda path: (read.append(path), entry(path))[1])
    for expected in (10, 0):
        (scene,) = look([tmp_path / "a"], BatchOptions())
        stand(scene)
        assert len(read) == expected
        read.clear()


def test_scenes_that_collide_are_refused(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        tiny_scene(tmp_path, name)
    scene = tmp_path / "b/scene.yaml"
    scene.write_text(scene.read_text().replace("output: run", "output: ../a/run"))
    options = BatchOptions()
    found = look([tmp_path / n for n in "abc"], options)
    assert [str(tmp_path / "a/run") in (s.problem or "") for s in found] == [True, True, False]
    assert found[2].problem is None
    twice = look([tmp_path / "c", tmp_path / "c/scene.yaml", tmp_path / "a"], options)
    assert ["the same scene" in (s.problem or "") for s in twice] == [True, True, False]
    scene.write_text(scene.read_text().replace("output: ../a/run", "").replace("name: b", "name: a"))
    assert all(s.problem is None for s in look([tmp_path / "a", tmp_path / "b"], options))


def test_one_that_fails_while_it_runs_stops_no_other(tmp_path: Path, devrf: Command) -> None:
    for name in ("a", "b"):
        tiny_scene(tmp_path, name)
    scenes = (tmp_path / "a", tmp_path / "b")
    with Workspace(tmp_path / "a/run"):  # somebody else's run
        result = devrf("batch", *scenes, "--until", "scene", "--device", "cpu", "--out", tmp_path / "o")
    rows = by_name(tmp_path / "o")
    assert result.code == rows["a"]["code"] == BAD_INPUT, result.said
    assert "another run" in rows["a"]["message"] and rows["b"]["state"] == "done"


def test_a_scene_is_run_from_the_first_stage_that_is_to_be_made(tmp_path: Path) -> None:
    (scene,) = look([tiny_scene(tmp_path, "a")], BatchOptions())
    names = ("ingest", "scene", "flow", "canonical", "report")

    def to_do(*fresh: str) -> list[str]:
        stages = (stage for stage in STAGES if stage.name in names)
        scene.standing = [Standing(s, "fresh" if s.name in fresh else "missing", ()) for s in stages]
        return scene.to_do

    assert to_do() == list(names)
    assert to_do("ingest", "flow") == list(names[1:])
    assert to_do(*names[:4]) == ["report"]
    assert to_do(*names) == []


@pytest.mark.parametrize(
    ("cores", "gpus", "jobs", "expected"),
    [
        (8, 0, None, (2, 4, 0)),  # as much as memory allows
        (2, 0, None, (1, 2, 0)),
        (8, 0, 4, (4, 2, 0)),
        (8, 2, None, (2, 4, 2)),
        (8, 2, 6, (2, 4, 2)),  # a GPU each
        (8, 2, 1, (1, 8, 2)),
    ],
)
def test_shares_of_this_machine(
    monkeypatch: pytest.MonkeyPatch, cores: int, gpus: int, jobs: int | None, expected: tuple[int, int, int]
) -> None:
    """Scenes at once, cores and memory of each, GPUs."""
    monkeypatch.setattr(command, "usable_cores", lambda: cores)
    monkeypatch.setattr(command, "left_bytes", lambda: 9e9 / (1 - command.RESERVE))
    monkeypatch.setattr(command, "resolve_device", lambda device: "cuda" if gpus else "cpu")
    monkeypatch.setattr("torch.cuda.device_count", lambda: gpus)
    pool = command._local(BatchOptions(jobs=jobs))
    assert (pool._places.qsize(), pool.threads, pool.gpus) == expected
    assert pool.memory_gb == pytest.approx(9 / expected[0])


@pytest.mark.parametrize(
    ("seen", "expected"), [(None, "1"), ("", "1"), ("2,5", "5"), ("GPU-aa, GPU-bb", "GPU-bb")]
)
def test_a_task_gets_one_of_the_gpus_that_the_user_gave(
    monkeypatch: pytest.MonkeyPatch, seen: str | None, expected: str
) -> None:
    if seen is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    else:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", seen)
    task = Task(Path("scene.yaml"), Path("run"), ("canonical",), (), 1, True)
    assert batch_task._environment(task, 1)["CUDA_VISIBLE_DEVICES"] == expected
    assert batch_task._environment(task, None).get("CUDA_VISIBLE_DEVICES") == seen


def test_stopped_before_it_listens_it_is_no_failure(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a", LONG)
    task = Task(scene, tmp_path / "a/run", ("scene",), ("--device", "cpu"), 1, False)
    asked = iter((False, True))  # once the process has only just been started
    assert run_task(task, lambda: next(asked)).code == STOPPED


def test_a_gpu_that_is_not_there_is_said_before_the_scenes_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.setattr(command, "look", lambda *arguments, **options: pytest.fail("looked"))
    for device, refusal in (("cuda", "gpu-missing"), ("gpu", "option-unknown-value")):
        with refused(refusal, f"--device {device}", kind=InputError):
            command.batch(Talk("quiet"), [tmp_path], BatchOptions(device=device, out=tmp_path / "o"))


def test_a_summary_that_cannot_be_made_is_a_mistake_of_the_command() -> None:
    with refused("folder-unwritable", "--out /proc/x: ", kind=InputError):
        command.batch(Talk("quiet"), [Path("a")], BatchOptions(out=Path("/proc/x")))


def test_an_option_that_is_gone_says_what_to_do(devrf_process: Command, tmp_path: Path) -> None:
    result = devrf_process("batch", tmp_path, "--store=s3://bucket/night")
    assert result.code == BAD_INPUT
    assert "--store: is no longer an option" in result.said and "[option-gone]" in result.said


# --- stopped, killed ---


def batch_in_course(folder: Path) -> subprocess.Popen:
    """A batch of two scenes that train for long."""
    scenes = [str(tiny_scene(folder, name, LONG).parent) for name in ("a", "b")]
    words = ["-m", "devrf.pipelines.cli.main", "batch", *scenes, "--device", "cpu", "--jobs", "1"]
    process = subprocess.Popen(
        [sys.executable, *words, "--out", str(folder / "o")], stderr=subprocess.PIPE, text=True
    )
    try:
        wait_for(lambda: list(folder.glob("a/run/.new-canonical*")), process=process)
    except BaseException:
        process.kill()
        raise
    return process


def test_terminated_it_ends_what_runs_and_begins_nothing_more(tmp_path: Path) -> None:
    process = batch_in_course(tmp_path)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=60)
    assert process.returncode == STOPPED
    assert "b: " in said and "[scene-stopped]" in said
    assert all(row["message"] == STOPPED_MESSAGE for row in by_name(tmp_path / "o").values())
    assert {name: row["state"] for name, row in by_name(tmp_path / "o").items()} == {
        "a": "stopped",
        "b": "stopped",
    }
    assert not list(tmp_path.glob("*/run/.lock")) and not list(tmp_path.glob("*/run/.new-*"))
    assert (tmp_path / "a/run/scene/stamp.json").is_file()
    assert [path.name for path in (tmp_path / "b/run").iterdir()] == [".digests.json"]  # of the look at it


def test_killed_it_leaves_no_run_behind(tmp_path: Path) -> None:
    process = batch_in_course(tmp_path)
    process.kill()
    process.communicate()
    wait_for(lambda: not list(tmp_path.glob("*/run/.lock")))
    assert not list(tmp_path.glob("*/run/.new-*"))


def test_a_run_that_is_killed_is_a_failure_with_a_message(tmp_path: Path) -> None:
    scene = tiny_scene(tmp_path, "a", LONG)
    run_dir = tmp_path / "a/run"
    task = Task(scene, run_dir, ("scene", "canonical"), ("--device", "cpu"), 1, False)

    def kill_it() -> bool:
        for lock in run_dir.glob(".lock"):
            if list(run_dir.glob(".new-canonical*")):
                with contextlib.suppress(
                    ProcessLookupError, ValueError
                ):  # killed; its lock is not cleared away, or half
                    os.kill(json.loads(lock.read_text())["pid"], signal.SIGKILL)
        return False

    ended = run_task(task, kill_it)
    assert ended.code == FAILED
    assert ended.message is not None and "SIGKILL" in ended.message


def test_an_error_of_ours_ends_the_run_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, run_dir = tiny_scene(tmp_path, "a", LONG), tmp_path / "a/run"
    task = Task(scene, run_dir, ("scene", "canonical"), ("--device", "cpu"), 1, False)
    started: list[subprocess.Popen] = []
    start = subprocess.Popen

    def full() -> bool:
        if list(run_dir.glob(".new-canonical*")):
            raise OSError(28, "No space left on device")
        return False

    monkeypatch.setattr(
        batch_task.subprocess, "Popen", lambda *a, **k: (started.append(start(*a, **k)), started[-1])[1]
    )
    ended = run_task(task, full)
    assert ended.code == FAILED and ended.message is not None and "No space left" in ended.message
    assert [process.returncode for process in started] == [STOPPED]
    assert not list(run_dir.glob(".lock")) and not list(run_dir.glob(".new-*"))
