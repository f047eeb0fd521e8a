"""Runs killed and stopped, at random moments and right before changes of files."""

import math
import os
import random
import re
import shutil
import signal
import time
from pathlib import Path

import pytest
from tests.faults.conftest import TinyMaker
from tests.faults.harness import LIMIT_S, Count, Tiny, children_of, go_on

from devrf.pipelines.terminal.exit_codes import DONE, FAILED, STOPPED

CODES = {"SIGKILL": (FAILED, -signal.SIGKILL), "SIGTERM": (STOPPED, -signal.SIGTERM), "SIGINT": (STOPPED,)}
TOO_MANY = 20  # kills for one that takes effect; 1.4 to 2.6 in the full suite
FORCED = "force=all"  # of a finished run: every stage is made again, folders are swapped


def start_from(tiny: Tiny, reference: Path, made: bool) -> tuple[str, ...]:
    """Begin with nothing, or with a finished run that is made again; the settings of the run."""
    if made:
        shutil.copytree(reference, tiny.run_dir)
    return (FORCED,) if made else ()


def check_ending(code: int, err: str, sign: str) -> bool:
    """Whether a run ended by a signal, as it should."""
    assert "Traceback" not in err, err
    assert code in (DONE, *CODES[sign]), (code, err)  # done: the signal came too late
    assert code != -signal.SIGTERM or not err  # it had not begun
    assert code != STOPPED or re.fullmatch(r"(.* \[stopped\]\n)?", err), err
    assert code != FAILED or re.search(r"SIGKILL.* \d+\.\d GB.*\[program-killed\]", err), err
    return code != DONE


@pytest.mark.full
def test_killed_before_a_change_of_a_file(new_tiny: TinyMaker, reference: Path, faults: str, figures) -> None:
    """Evenly spread over the run: a few changes, or every third one."""
    rng, count, points = random.Random(1), Count(), 0
    for made in (False, True):
        at, step = 1, 3 if faults == "full" else 29
        while True:
            tiny = new_tiny()
            settings = start_from(tiny, reference, made)
            victims, sign = rng.choice(("child", "parent", "both")), "SIGKILL"
            if rng.random() < 0.3:
                victims, sign = "parent", rng.choice(("SIGTERM", "SIGINT"))
            result = tiny.run(*settings, f"at={at}", f"victims={victims}", f"sign={sign}")
            ended = check_ending(result.returncode, result.stderr, sign)
            count.took_effect += ended
            go_on(tiny, reference, count)
            shutil.rmtree(tiny.folder)
            if not ended and sign == "SIGKILL":
                break  # the run has fewer changes than that
            points, at = points + 1, at + step
    assert points > (80 if faults == "full" else 5)
    assert count.used_again == count.finished_before > 0
    figures(points=points, **count.figures())


@pytest.mark.parametrize("part", [0, *(pytest.param(part, marks=pytest.mark.full) for part in (1, 2, 3))])
def test_killed_at_random_moments(
    new_tiny: TinyMaker, reference: Path, faults: str, figures, part: int
) -> None:
    """Up to three times in a row, then to the end; 200 times in all in the full suite, those too late not counted."""
    rng, count, kills = random.Random(part), Count(), 0
    wanted, run_s = 50 if faults == "full" else 3, math.inf
    for _ in range(2):  # the quicker of two: other work beside one makes moments of it too late
        begun = time.monotonic()
        assert new_tiny().run().returncode == DONE
        run_s = min(run_s, time.monotonic() - begun)
    while count.took_effect < wanted:
        tiny = new_tiny()
        settings = start_from(tiny, reference, made=rng.random() < 0.5)
        for _ in range(rng.randint(1, 3)):
            started = tiny.start(*settings)
            sign = rng.choice(("SIGKILL", "SIGKILL", "SIGTERM", "SIGINT"))
            deadline = time.monotonic() + LIMIT_S
            while not (children := children_of(started.pid)):
                assert time.monotonic() < deadline
                time.sleep(0.002)
            time.sleep(rng.uniform(0, run_s))
            victim = started.pid if sign != "SIGKILL" or rng.random() < 0.5 else children[0]
            try:
                os.kill(victim, signal.Signals[sign])
            except ProcessLookupError:
                pass
            ended = started.end()
            count.took_effect += check_ending(ended.returncode, ended.stderr, sign)
            kills += 1
            assert kills < TOO_MANY * wanted
        go_on(tiny, reference, count)
        shutil.rmtree(tiny.folder)
    assert count.used_again == count.finished_before
    figures(kills=kills, **count.figures())


@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_check_that_can_fail(tiny: Tiny, reference: Path, at: int) -> None:
    """A file that was changed, a stage made twice, and a leftover are found."""
    shutil.copytree(reference, tiny.run_dir)
    if at == 1:
        file = tiny.run_dir / "big" / "big.bin"
        file.write_bytes(b"x" + file.read_bytes()[1:])
    elif at == 2:
        (tiny.run_dir / "last" / "summary.json").unlink()
    else:
        (tiny.run_dir / ".parts").mkdir()
    with pytest.raises(AssertionError):
        go_on(tiny, reference, Count())
