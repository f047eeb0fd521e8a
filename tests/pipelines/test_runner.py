"""The runner on small stages that write text: what runs, what is skipped, what survives.

Run as a program, this file executes the same stages in a process of its own, so that it can be killed.
"""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
import typer
from tests.pipelines.small_stages import ALL, executed, job, small_stages, stage, write
from tests.refused import refused
from tests.waiting import wait_for

from devrf.capture.measure import Measure
from devrf.capture.system.errors import CaptureError, HealthError, InputError, OutOfTime
from devrf.pipelines.cli.main import render
from devrf.pipelines.cli.run_command import say_where
from devrf.pipelines.run_folder.outcomes import error_path
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.runner.run_state import check_choice, dry_run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stage import Stage, StageContext
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE, FAILED, STOPPED, UNHEALTHY


def test_from_until_force(folder: Path) -> None:
    assert executed(folder, choice=Choice(last="second")) == ["first", "second"]
    assert executed(folder, choice=Choice(first="third")) == ["third"]
    assert executed(folder) == ["other"]
    assert executed(folder, choice=Choice(force=("second",))) == ["second"]  # and came out the same
    assert executed(folder, choice=Choice(force=("all",))) == ALL
    # stages before --from are taken as they are, even where they are stale
    assert executed(folder, "reconstruct.rays=700", choice=Choice(first="third")) == []


def test_from_without_what_it_reads_is_refused(folder: Path, capsys: pytest.CaptureFixture) -> None:
    third = Choice(first="third")
    assert execute(job(folder, small_stages(), choice=third)) == BAD_INPUT
    said = capsys.readouterr().err
    assert "third reads second" in said and "--from first" in said and "[stage-not-made]" in said
    assert not (folder / "run").exists()
    executed(folder, choice=Choice(last="first"))
    assert execute(job(folder, small_stages(), choice=third)) == BAD_INPUT
    assert "--from second" in capsys.readouterr().err
    assert not error_path(folder / "run", "third").exists()


def test_only_what_is_fresh_is_named(folder: Path, capsys: pytest.CaptureFixture) -> None:
    """Numbers and film of an earlier run are not this one's results."""

    def named(choice: Choice) -> list[str]:
        run = job(
            folder,
            (
                stage("flow", (), ()),
                stage("evaluate", ("flow",), (), lambda c: put(c.out / "metrics.json")),
                stage("render", ("flow",), (), lambda c: put(c.out / "orbit.mp4")),
            ),
            choice=choice,
        )
        assert execute(run) == DONE
        run.talk = Talk("normal")
        say_where(run)
        return [line.split(":")[0].strip() for line in capsys.readouterr().out.splitlines()]

    def put(path: Path) -> None:
        path.write_text("x")

    assert named(Choice()) == ["film", "numbers"]
    assert named(Choice()) == ["film", "numbers"]  # skipped as fresh
    assert named(Choice(last="flow", force=("flow",))) == []
    assert named(Choice(first="evaluate", last="evaluate")) == ["numbers"]


def test_a_film_of_a_scene_that_never_ran_is_refused(folder: Path, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(typer.Exit) as ended:
        render(folder / "scene.yaml")
    assert ended.value.exit_code == BAD_INPUT
    assert f"(devrf-pipeline run {folder}/scene.yaml)" in capsys.readouterr().err
    assert not (folder / "run").exists()


@pytest.mark.parametrize(
    ("choice", "named"),
    [
        (Choice(first="frist"), ("--from frist: ", " first, second, other, third")),
        (Choice(last="x"), ("--until x: ", " first, second, other, third")),
        (Choice(force=("x", "y")), ("--force x: ", "--force y: ")),
        (Choice(first="third", last="first"), ("--from third --until first: ",)),
        (Choice(first="second", force=("first", "third")), ("--force first: ", " --from and --until ")),
        (Choice(last="first", force=("third",)), ("--force third: ", " --from and --until ")),
    ],
)
def test_choice_is_checked(folder: Path, choice: Choice, named: tuple[str, ...]) -> None:
    with refused("stages-misnamed", *named, kind=InputError) as caught:
        check_choice(job(folder, small_stages(), choice=choice))
    assert len(str(caught.value).splitlines()) == sum(name[0] == "-" for name in named)


def test_what_is_forced_may_lie_within_the_range(folder: Path) -> None:
    for force in ("second", "third", "all"):
        check_choice(job(folder, small_stages(), choice=Choice("second", "third", (force,))))


def test_dry_run_touches_nothing(folder: Path, capsys: pytest.CaptureFixture) -> None:
    run = job(folder, small_stages())
    run.talk = Talk("normal")
    dry_run(run, run.standings())
    assert "first: would run: " in capsys.readouterr().out
    assert not (folder / "run").exists()
    executed(folder)
    run = job(folder, small_stages(), "reconstruct.rays=500")
    run.talk = Talk("normal")
    dry_run(run, run.standings())
    out = capsys.readouterr().out
    assert "first: skipped" in out
    assert re.search("second: would run: reconstruct.rays: 100 .* 500", out)
    assert "third: would run: second" in out


# --- failures ---


def fail(error: BaseException) -> Callable[[StageContext], None]:
    def work(context: StageContext) -> None:
        (context.out / "half.txt").write_text("half")
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "code", "expected"),
    [
        (
            CaptureError("clip-damaged", "clip.mp4: at 3.2 s"),
            FAILED,
            "second: clip.mp4: at 3.2 s [clip-damaged]",
        ),
        (InputError("file-not-video", "clip.mp4: text"), FAILED, "second: clip.mp4: text [file-not-video]"),
        (HealthError("board-never-seen", "of cam1"), UNHEALTHY, "second: of cam1 [board-never-seen]"),
        (OutOfTime("out-of-time", "step 2"), FAILED, "[out-of-time]"),
        (OSError(errno.ENOSPC, "No space left on device"), FAILED, "[disk-full]"),
        (RuntimeError("write: No space left on device"), FAILED, "[disk-full]"),
        (OSError(errno.EFBIG, "File too large"), FAILED, "[system-refused]"),
        (PermissionError(errno.EROFS, "Read-only", "/usb/x"), FAILED, "second: /usb/x: "),
        (MemoryError(), FAILED, "[no-memory]"),
        (ZeroDivisionError("division"), FAILED, "[unexpected]"),
        (SystemExit(3), FAILED, "[library-ended-program]"),
        (KeyboardInterrupt(), STOPPED, "[stopped]"),
    ],
)
def test_a_failure_keeps_what_was_there(
    folder: Path, error: BaseException, code: int, expected: str, capsys: pytest.CaptureFixture
) -> None:
    executed(folder)
    run = job(folder, small_stages(second=fail(error)), "reconstruct.rays=200")
    assert execute(run) == code
    assert expected in capsys.readouterr().err
    assert (folder / "run/second/sub/result.txt").read_text() == "second"  # the old result
    assert not list((folder / "run").glob(".new-*"))
    assert executed(folder, "reconstruct.rays=200") == ["second", "third"]


def test_a_run_folder_that_is_moved_away_while_it_works(folder: Path, capsys: pytest.CaptureFixture) -> None:
    """The next run, where the folder is now, has what was finished."""

    def moves(context: StageContext) -> None:
        (folder / "run").rename(folder / "moved")

    assert execute(job(folder, small_stages(second=moves))) == FAILED
    assert "[system-refused]" in capsys.readouterr().err
    assert executed(folder, "output=moved") == ["second", "other", "third"]


def test_an_error_before_the_first_stage_leaves_its_trace(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.delattr("devrf.__version__")  # a library that is found by half
    assert execute(job(folder, small_stages())) == FAILED
    said = capsys.readouterr().err
    assert str(folder / "run/devrf.log") in said and "[unexpected]" in said
    assert "Traceback" in (folder / "run/devrf.log").read_text()


def test_more_than_the_gpus_budget_is_said_to_be_that(folder: Path, capsys: pytest.CaptureFixture) -> None:
    error = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB")
    run = job(folder, small_stages(second=fail(error)), "budget.gpu_memory_gb=2")
    run.device = "cuda"
    assert execute(run) == FAILED
    said = " ".join(capsys.readouterr().err.split())
    assert "budget.gpu_memory_gb (2)" in said and "reconstruct.rays" in said and "3.00 GiB" in said
    run = job(folder, small_stages(second=fail(MemoryError())), "budget.gpu_memory_gb=2")
    run.device = "cuda"  # main memory has run out, not the GPU's
    assert execute(run) == FAILED
    assert "budget.gpu_memory_gb" not in capsys.readouterr().err


def test_a_failure_is_remembered_until_it_is_mended(folder: Path) -> None:
    run = job(folder, small_stages(second=fail(CaptureError("clip-damaged", "damaged"))))
    assert execute(run) == FAILED
    found = run.standings()
    assert [now.state for now in found] == ["fresh", "missing", "missing", "missing"]
    assert found[1].error == "second: damaged"
    remembered = json.loads(error_path(run.run_dir, "second").read_text())
    assert remembered == {"message": "second: damaged", "code": FAILED, "error": "clip-damaged"}
    assert "Traceback" in (folder / "run/devrf.log").read_text()
    executed(folder)
    assert run.standings()[1].error is None


def test_a_forced_stage_that_was_stopped_runs_again(folder: Path) -> None:
    executed(folder)
    forced = Choice(force=("second",))
    assert execute(job(folder, small_stages(second=fail(KeyboardInterrupt())), choice=forced)) == STOPPED
    run = job(folder, small_stages())
    found = run.standings()
    assert [now.why for now in found] == [(), ("forced before, and not finished",), (), ("second runs",)]
    assert executed(folder) == ["second"]
    assert executed(folder) == []


def test_a_signal_right_after_a_folder_was_made_leaves_none(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Path.mkdir

    def stopped(path: Path, *args: Any, **options: Any) -> None:
        made(path, *args, **options)
        if path.name.startswith(".new-second-"):
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "mkdir", stopped)
    assert execute(job(folder, small_stages())) == STOPPED
    assert not list((folder / "run").glob(".new-*"))


def test_what_a_native_program_said_is_kept(folder: Path, capsys: pytest.CaptureFixture) -> None:
    def work(context: StageContext) -> None:
        (context.out / "colmap.log").write_text("what it said last")
        raise CaptureError("program-crashed", "crashed")

    assert execute(job(folder, small_stages(second=work))) == FAILED
    log = folder / "run/logs/second-colmap.log"
    assert f"log: {log}" in "".join(capsys.readouterr().err.splitlines())
    assert log.read_text() == "what it said last"
    executed(folder)
    assert not log.exists()


def unhealthy(context: StageContext) -> None:
    write("poor")(context)
    context.measures.append(Measure("sweep-error", 9.0))


def test_a_failed_row_stops_the_run_and_keeps_the_result(folder: Path, capsys: pytest.CaptureFixture) -> None:
    run = job(folder, small_stages(second=unhealthy))
    assert execute(run) == UNHEALTHY
    assert run.executed == ["first", "second"]
    assert "lock focus and zoom." in capsys.readouterr().err
    again = job(folder, small_stages(second=unhealthy))
    assert execute(again) == UNHEALTHY  # refused again, without doing it again
    assert again.executed == []
    assert executed(folder, choice=Choice(allow_unhealthy=True), second=unhealthy) == ["other", "third"]


def test_output_that_cannot_be_written(folder: Path, capsys: pytest.CaptureFixture) -> None:
    (folder / "file").write_text("in the way")
    assert execute(job(folder, small_stages(), "output=file/run")) == BAD_INPUT
    said = capsys.readouterr().err
    assert str(folder / "file/run") in said and "[folder-unwritable]" in said


def test_a_swap_half_done_is_finished_or_undone(folder: Path) -> None:
    executed(folder)
    run_dir = folder / "run"
    (run_dir / "second").rename(run_dir / ".old-second-abcdef")  # killed between the two renames
    (run_dir / ".new-second-1-abcdef").mkdir()
    (run_dir / ".new-second-1-abcdef" / "half.txt").write_text("half")
    assert executed(folder) == []  # the old one is back
    (run_dir / "second").rename(run_dir / ".old-second-abcdef")
    (run_dir / "third").rename(run_dir / ".new-third-1-abcdef")  # never had a name: not trusted
    assert executed(folder) == ["third"]


def test_what_a_run_has_not_made_is_not_cleared_away(folder: Path) -> None:
    executed(folder)
    run_dir = folder / "run"
    mine = [".new-ideas/a", ".old-photos-1/a", ".notes.tmp", ".third.mine.safetensors", "logs/mine.log"]
    for name in mine:
        (run_dir / name).parent.mkdir(exist_ok=True)
        (run_dir / name).write_text("mine")
    os.utime(run_dir / ".third.mine.safetensors", (0, 0))  # older than the stage
    assert executed(folder, choice=Choice(force=("third",))) == ["third"]
    assert [(run_dir / name).read_text() for name in mine] == ["mine"] * len(mine)


# --- killed ---


def program(folder: Path, hangs: str) -> int:
    """A run that never comes to the end of one stage."""

    def hang(context: StageContext) -> None:
        (context.out / "half.txt").write_text("half")
        time.sleep(600)

    return execute(job(folder, small_stages(**{hangs: hang})))


def hanging(folder: Path, stage: str) -> "subprocess.Popen[str]":
    """A run in a process of its own, in the middle of a stage."""
    command = [sys.executable, "-m", "tests.pipelines.test_runner", str(folder), stage]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    wait_for(lambda: list((folder / "run").glob(f".new-{stage}-*/half.txt")), process=process)
    return process


@pytest.mark.parametrize("at", [ALL[0], *(pytest.param(stage, marks=pytest.mark.full) for stage in ALL[1:])])
def test_killed_at_any_point_the_next_run_goes_on(folder: Path, at: str) -> None:
    started = hanging(folder, at)
    started.kill()
    started.communicate()
    finished = [name for name in ALL if (folder / "run" / name).exists()]
    assert finished == ALL[: ALL.index(at)]
    assert executed(folder) == ALL[len(finished) :]
    assert not list((folder / "run").glob(".new-*"))


def test_terminated_it_cleans_up(folder: Path) -> None:
    started = hanging(folder, "first")
    started.terminate()
    _, err = started.communicate(timeout=90)
    assert started.returncode == STOPPED
    assert "[stopped]" in err
    assert not list((folder / "run").glob(".new-*"))


def test_a_signal_in_a_callback_of_the_garbage_collector_is_not_lost(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    class Dropped:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)
            time.sleep(0)  # here the handler raises, where nothing can be raised

    def work(context: StageContext) -> None:
        Dropped()
        for _ in range(1000):
            time.sleep(0.001)

    assert execute(job(folder, small_stages(second=work))) == STOPPED
    said = capsys.readouterr().err
    assert "[stopped]" in said and "Exception ignored" not in said


def test_reads_of_leaves_out_what_does_not_apply(folder: Path) -> None:
    first = Stage("first", (), (), lambda config: "no sweep", write("x"))
    second = stage("second", ("first",), ())
    run = job(folder, (first, second))
    assert run.reads_of(second) == []
    assert execute(run) == DONE
    assert run.executed == ["second"]


if __name__ == "__main__":
    sys.exit(program(Path(sys.argv[1]), sys.argv[2]))
