"""What the runner and its parent process cost."""

import json
import os
import resource
import subprocess
import sys
import time
from datetime import datetime
from pathlib import Path

import pytest
from tests.conftest import ExampleRun
from tests.faults.harness import Tiny

from devrf.capture.system.durable import sync, sync_tree
from devrf.pipelines.terminal.exit_codes import DONE

pytestmark = pytest.mark.full

MOST_SHARE = 0.02  # of a stage's time
MOST_S = 0.25  # where that is more: putting a stage on the disk takes a while however short it was
NOTHING_STALE_S = 1.0  # processor time; wall-clock time is the same where no one else works
PARENTS_SHARE = 0.02  # of the run's time that the parent may take of a core, watching


@pytest.fixture(scope="session", autouse=True)
def by_hand(request: pytest.FixtureRequest) -> None:
    """Machines that others use too measure nothing. Of the session's scope, to come before the example's run."""
    if request.config.getoption("--faults") != "full":
        pytest.skip("a measurement, made by hand: --faults full")


def test_a_run_in_which_nothing_is_stale(example_run: ExampleRun, figures) -> None:
    overrides = ("--preset", "tiny", "--set", "output=run")
    command = [sys.executable, "-m", "devrf.pipelines.cli.main", "run", str(example_run.scene), *overrides]
    wall, processor = [], []
    for _ in range(3):
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.monotonic()
        result = subprocess.run(command, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert result.returncode == DONE and ": runs:" not in result.stdout, result
        wall.append(time.monotonic() - start)
        processor.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    figures(wall_s=round(min(wall), 3), processor_s=round(min(processor), 3))
    assert min(processor) <= NOTHING_STALE_S


def test_the_runners_share_of_a_stage(example_run: ExampleRun, figures) -> None:
    """From a stage's first event to its last, but for the time in the stage itself."""
    events = [json.loads(line) for line in (example_run.run_dir / "events.jsonl").read_text().splitlines()]
    started = {event["stage"]: event for event in events if event["event"] == "stage_started"}
    shares = {}
    for event in events:
        if event["event"] != "stage_finished":
            continue
        whole_s = _seconds(event) - _seconds(started[event["stage"]])
        shares[event["stage"]] = (round(whole_s - event["seconds"], 3), round(event["seconds"], 3))
    figures(overhead_s_of_s=shares)
    assert len(shares) == 12
    for stage, (overhead_s, stage_s) in shares.items():
        assert overhead_s <= max(MOST_SHARE * stage_s, MOST_S), (stage, overhead_s, stage_s)


def test_a_stage_of_many_files_is_put_on_the_disk(tmp_path: Path, figures) -> None:
    """All files at once against one after the other."""
    files, took = 1000, {}
    for way, put in (("at_once_s", sync_tree), ("one_by_one_s", _sync_each)):
        folder = tmp_path / way
        folder.mkdir()
        for number in range(files):
            (folder / f"{number:04d}.bin").write_bytes(bytes([number % 256]) * 20_000)
        start = time.monotonic()
        put(folder)
        took[way] = round(time.monotonic() - start, 3)
    figures(files=files, **took)
    assert took["at_once_s"] < took["one_by_one_s"]


def _sync_each(folder: Path) -> None:
    for path in [*folder.iterdir(), folder]:
        sync(path)


def test_the_parent_costs_next_to_nothing(tiny: Tiny, figures) -> None:
    """Processor time of the parent alone, which looks at memory all the time."""
    started = tiny.at_work("frames", "fault=sleep")
    time.sleep(0.5)
    ticks, start = _ticks(started.pid), time.monotonic()
    time.sleep(4.0)
    share = (_ticks(started.pid) - ticks) / os.sysconf("SC_CLK_TCK") / (time.monotonic() - start)
    started.terminate()
    started.end()
    figures(parents_share=round(share, 4))
    assert share <= PARENTS_SHARE


def _ticks(pid: int) -> int:
    with open(f"/proc/{pid}/stat") as file:
        fields = file.read().rsplit(")", 1)[1].split()
    return int(fields[11]) + int(fields[12])


def _seconds(event: dict) -> float:
    return datetime.fromisoformat(event["time"].replace("Z", "+00:00")).timestamp()
