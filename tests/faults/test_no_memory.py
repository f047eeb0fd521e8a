"""Too little memory: allocations that fail, the budget's limit, and the system's own way of dealing with it."""

import os
import random
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
from tests.faults.conftest import TinyMaker
from tests.faults.harness import Count, Tiny, children_of, go_on
from tests.faults.test_killed import start_from
from tests.faults.tiny_stages import NAMES

from devrf.pipelines.terminal.exit_codes import DONE, FAILED

pytestmark = pytest.mark.full
SAID = {
    "allocation": r"\[no-memory\]",
    "budget": r"budget\.memory_gb.* \[no-memory\]",
    "system": r"SIGKILL.* \[program-killed\]",
}


def allocation_fails(tiny: Tiny, rng: random.Random, settings: tuple[str, ...]) -> tuple[int, str]:
    """The system refuses at a random level: at once, between stages, or in the stage that needs most."""
    result = tiny.run(*settings, f"room={rng.randint(0, 40_000_000)}")
    return result.returncode, result.stderr


def budget_is_kept(tiny: Tiny, rng: random.Random, settings: tuple[str, ...]) -> tuple[int, str]:
    """A stage takes more and more; the parent ends the run."""
    stage = rng.choice(NAMES)
    if (tiny.run_dir / stage).exists():
        settings = (f"force={stage}",)
    limit = f"budget.memory_gb={rng.uniform(0.05, 0.4):.3f}"
    result = tiny.run(*settings, f"stage={stage}", "fault=eat", limit)
    assert result.returncode == FAILED
    return result.returncode, result.stderr


def system_kills(tiny: Tiny, rng: random.Random, settings: tuple[str, ...]) -> tuple[int, str]:
    """What the kernel does to the largest process."""
    started = tiny.start(*settings)
    time.sleep(rng.uniform(0.0, 0.5))
    for child in children_of(started.pid) if started.poll() is None else []:
        os.kill(child, signal.SIGKILL)
    ended = started.end()
    return ended.returncode, ended.stderr


def test_no_memory_costs_no_more_than_the_stage(
    new_tiny: TinyMaker, reference: Path, faults: str, figures
) -> None:
    rng, count, ways = random.Random(5), Count(), dict.fromkeys(("allocation", "budget", "system"), 0)
    faulty = {"allocation": allocation_fails, "budget": budget_is_kept, "system": system_kills}
    while count.faults < (60 if faults == "full" else 9):
        way = list(ways)[count.faults % 3]
        tiny = new_tiny()
        settings = start_from(tiny, reference, made=rng.random() < 0.4)
        code, err = faulty[way](tiny, rng, settings)
        assert "Traceback" not in err, err
        assert code in (DONE, FAILED), err
        if code == FAILED:
            count.took_effect += 1
            ways[way] += 1
            assert re.search(SAID[way], err), err
        go_on(tiny, reference, count)
        shutil.rmtree(tiny.folder)
    assert min(ways.values()) > 0
    assert count.used_again == count.finished_before > 0
    figures(ways=ways, **count.figures())
