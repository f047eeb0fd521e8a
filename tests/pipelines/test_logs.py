"""What a run leaves to be read: a log per run, events for programs, and what is said on the way."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.console import Console
from tests.conftest import Command
from tests.faults.harness import Tiny
from tests.faults.tiny_stages import prepare
from tests.pipelines.small_stages import ALL, job, small_stages, write

from devrf.capture.system.errors import CaptureError
from devrf.pipelines.health.judge import HealthRow
from devrf.pipelines.runner.execute import execute
from devrf.pipelines.stage import StageContext
from devrf.pipelines.terminal import console, logs
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.exit_codes import DONE, FAILED
from devrf.pipelines.terminal.logs import EVENTS_FILE, LOG_FILE, Events
from devrf.pipelines.terminal.tables import print_table


def events_of(run_dir: Path) -> list[dict]:
    return [json.loads(line) for line in (run_dir / EVENTS_FILE).read_text().splitlines()]


def test_what_names_say_does_not_steer_a_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steers = "\x1b]0;title\a\x1b[31m\r\x9b\u202e\udcff[red]\ttext"
    shown = r"\x1b]0;title\x07\x1b[31m\r\x9b\u202e\udcff[red]"
    talk = Talk("verbose")
    with logs.log_file(folder, "a run"):
        talk.say(steers)
        talk.detail(steers)
        talk.error(steers, "code")
        talk.health("second", [HealthRow("noted", steers, steers, "", None, None, "fail", steers)])
        print_table(talk, steers, [steers], [[steers]])
        said = capsys.readouterr()
    log = (folder / LOG_FILE).read_text()
    for text, count in ((said.out, 4), (said.err, 1), (log, 4)):
        assert not set("\x1b\a\r\x9b\u202e") & set(text)
        assert text.count(shown) >= count


def test_a_run_tells_programs_what_happened(folder: Path) -> None:
    def deciding(context: StageContext) -> None:
        context.say("  fewer voxels: the pictures show no more")
        write("second")(context)

    assert execute(job(folder, small_stages(second=deciding))) == DONE
    run = job(folder, small_stages(), "reconstruct.seed=2")
    assert execute(run) == DONE
    events = events_of(folder / "run")
    first = [event for event in events if event["run"] != run.name]
    second = [event for event in events if event["run"] == run.name]
    kinds = [event["event"] for event in first]
    assert kinds[0] == "run_started" and kinds[-1] == "run_finished"
    assert [e["stage"] for e in first if e["event"] == "stage_finished"] == ALL
    assert (first[-1]["code"], first[-1]["executed"]) == (0, ALL)
    (decided,) = (e for e in first if e["event"] == "decision")
    assert (decided["stage"], decided["text"]) == ("second", "fewer voxels: the pictures show no more")
    (health,) = (e for e in first if e["event"] == "health" and e["stage"] == "second")
    assert health["code"] == "sweep-overlay" and health["value"] == 0.0 and health["verdict"] == "ok"
    (started,) = (e for e in second if e["event"] == "stage_started")
    assert (started["stage"], started["why"]) == ("other", ["reconstruct.seed: 1 is now 2"])
    (finished,) = (e for e in second if e["event"] == "stage_finished")
    stamp = json.loads((folder / "run/other/stamp.json").read_text())
    assert finished["id"] == stamp["id"] and finished["seconds"] == stamp["seconds"] >= 0
    assert finished["peak_rss_gb"] > 0
    assert stamp["run"] == run.name  # from a number to its stage, to its run, to its log
    assert [e["stage"] for e in second if e["event"] == "stage_skipped"] == ["first", "second", "third"]
    times = [event["time"] for event in events]
    assert times == sorted(times)


def test_a_failure_is_among_them(folder: Path) -> None:
    def fail(context: StageContext) -> None:
        raise CaptureError("file-damaged", "clip.mp4: damaged at 3.2 s")

    assert execute(job(folder, small_stages(second=fail))) == FAILED
    failed, error, finished = events_of(folder / "run")[-3:]
    assert (failed["event"], failed["stage"], failed["code"]) == ("stage_failed", "second", 1)
    assert (error["event"], error["message"]) == ("error", "second: clip.mp4: damaged at 3.2 s")
    assert (finished["event"], finished["code"], finished["executed"]) == ("run_finished", 1, ["first"])


def test_what_cannot_be_a_number_is_null(tmp_path: Path) -> None:
    Events(tmp_path, "r").write("health", value=float("nan"), rows=[{"bound": float("inf")}])
    (event,) = events_of(tmp_path)
    assert event["value"] is None and event["rows"] == [{"bound": None}]


def test_progress_comes_every_few_seconds(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def busy(context: StageContext) -> None:
        for n in range(200):
            context.progress((n + 1) / 201, f"step {n}")
            time.sleep(0.001)
        write("x")(context)

    monkeypatch.setattr(console, "EVENT_EVERY_S", 0.05)
    assert execute(job(folder, small_stages(first=busy))) == DONE
    told = [e for e in events_of(folder / "run") if e["event"] == "progress" and e["stage"] == "first"]
    assert 1 <= len(told) <= 12
    assert told[0]["text"].startswith("step ") and 0 < told[0]["fraction"] < 1


def test_a_run_that_is_killed_is_finished_by_its_parent(tmp_path: Path) -> None:
    prepare(tmp_path)
    assert Tiny(tmp_path).run("fault=segfault", "stage=parts").returncode == FAILED
    *others, last = events_of(tmp_path / "run")
    assert (last["event"], last["code"], last["run"]) == ("run_finished", FAILED, others[0]["run"])
    assert others[-1]["event"] == "error" and others[-1]["message"].startswith("parts: ")
    assert [e["stage"] for e in others if e["event"] == "stage_finished"] == ["frames", "big"]
    assert f"run {last['run']}" in (tmp_path / "run" / LOG_FILE).read_text()


# --- torn and full ---


@pytest.mark.parametrize("torn", ['{"time": "2026', "x" * 3_000, "", "no line at all"])
def test_a_torn_line_is_cut_off(tmp_path: Path, torn: str) -> None:
    whole = '{"event": "a"}\n' if torn != "no line at all" else ""
    (tmp_path / EVENTS_FILE).write_text(whole + torn)
    Events(tmp_path, "r").write("b")
    assert [event["event"] for event in events_of(tmp_path)] == (["a", "b"] if whole else ["b"])


def test_killed_at_any_moment_only_the_last_line_may_be_torn(tmp_path: Path) -> None:
    program = (
        "import sys\nfrom pathlib import Path\nfrom devrf.pipelines.terminal.logs import Events\n"
        "events = Events(Path(sys.argv[1]), 'r')\n"
        "while True: events.write('row', text='x' * 5000)"
    )
    for n in range(3):
        writer = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)])
        deadline = time.monotonic() + 30
        before = (tmp_path / EVENTS_FILE).stat().st_size if n else 0
        while time.monotonic() < deadline:
            if (tmp_path / EVENTS_FILE).exists() and (tmp_path / EVENTS_FILE).stat().st_size > before:
                break
            time.sleep(0.005)
        time.sleep(0.02)
        writer.send_signal(signal.SIGKILL)
        writer.wait()
        whole = (tmp_path / EVENTS_FILE).read_text().rpartition("\n")[0].splitlines()
        assert whole and all(len(json.loads(line)["text"]) == 5000 for line in whole)
        Events(tmp_path, "r").write("row", text="x" * 5000)  # cuts off what the kill tore, and nothing else
        assert len(events_of(tmp_path)) == len(whole) + 1


def test_events_that_cannot_be_written_are_no_error(tmp_path: Path) -> None:
    Events(tmp_path / "nowhere", "r").write("a")
    (tmp_path / EVENTS_FILE).mkdir()
    Events(tmp_path, "r").write("a")
    assert list(tmp_path.rglob("*")) == [tmp_path / EVENTS_FILE]


# --- one log per run ---


def test_every_run_has_a_log_of_its_own(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logs, "KEPT_LOGS", 2)
    names, log = [], folder / "run" / LOG_FILE
    for n in range(4):
        run = job(folder, small_stages(), f"reconstruct.seed={n}")
        assert execute(run) == DONE
        names.append(run.name)
        os.utime(log, (n + 1, n + 1))  # four runs in a second, or in four nights
    text = log.read_text()
    assert f"run {names[3]}" in text and "reconstruct.seed: 2 is now 3" in text
    assert "seed: 1 is now 2" not in text
    old = sorted((folder / "run/logs").iterdir())
    assert [path.stem for path in old] == sorted(names[1:3])
    assert "reconstruct.seed: 1 is now 2" in (folder / f"run/logs/{names[2]}.log").read_text()


def test_a_log_of_an_earlier_version_is_put_away_by_its_time(folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run" / LOG_FILE).write_text("2026-01-01 INFO something else\n")
    assert execute(job(folder, small_stages())) == DONE
    (old,) = (folder / "run/logs").iterdir()
    assert old.read_text().startswith("2026-01-01") and old.stem[:8].isdigit()


def test_large_files_of_events_are_put_away(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert execute(job(folder, small_stages())) == DONE
    monkeypatch.setattr(logs, "EVENTS_BYTES", 100)
    run = job(folder, small_stages())
    assert execute(run) == DONE
    assert {event["run"] for event in events_of(folder / "run")} == {run.name}
    assert len(list((folder / "run/logs").glob("events-*.jsonl"))) == 1


def test_no_colours_and_no_bars_in_files(folder: Path) -> None:
    """On a terminal there are both."""
    run = job(folder, small_stages())
    run.talk = Talk("normal")
    screen = io.StringIO()
    run.talk.out = Console(file=screen, force_terminal=True, highlight=False, soft_wrap=True)
    assert execute(run) == DONE
    assert "\x1b[" in screen.getvalue()
    for name in (LOG_FILE, EVENTS_FILE):
        assert "\x1b" not in (folder / "run" / name).read_text()


# --- quiet and verbose ---


def test_quiet_says_only_errors_and_logs_all_the_same(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert execute(job(folder, small_stages())) == DONE
    said = capsys.readouterr()
    assert said.out == said.err == ""
    assert "first: runs: not made yet" in (folder / "run" / LOG_FILE).read_text()


@pytest.mark.parametrize(
    "command", ["run", "check", "report", "render", "batch", "export", "init", "simulate"]
)
def test_every_command_that_works_can_be_quiet_or_verbose(devrf: Command, command: str) -> None:
    """Verbose where stages run: the others have no more to say."""
    said = devrf(command, "--help").out
    assert "--quiet" in said
    assert ("--verbose" in said) == (command not in ("export", "init", "simulate"))
