"""Power cuts: both processes end at once, and what was not on the disk is lost.

The model: names (made, renamed, removed) are kept in their order up to the cut, as journals of file systems keep them;
of every file that was not put on the disk the content is lost with probability 0.7: it is empty, cut in half, or
zeros of the right length.
"""

import os
import random
import shutil
import time
from pathlib import Path

import pytest
from tests.faults.conftest import TinyMaker
from tests.faults.harness import Count, finished, go_on
from tests.faults.test_killed import start_from
from tests.faults.tracing import lose_what_was_not_on_disk

from devrf.pipelines.run_folder.lock import LEASE_S
from devrf.pipelines.terminal.exit_codes import DONE

pytestmark = pytest.mark.full

CHANGES = 210  # of files in a run, about
BOOT_S = LEASE_S + 1  # between a power cut and the next run


def test_what_counts_as_finished_was_on_the_disk(
    new_tiny: TinyMaker, reference: Path, faults: str, figures
) -> None:
    rng, count, lost = random.Random(3), Count(), 0
    while count.took_effect < (50 if faults == "full" else 10):
        tiny = new_tiny()
        on_disk = tiny.folder / "on_disk.txt"
        settings = start_from(tiny, reference, made=rng.random() < 0.5)
        for path in tiny.run_dir.rglob("*"):  # what lay there before is safe
            stat = path.stat()
            with on_disk.open("a") as file:
                file.write(f"{stat.st_ino} {stat.st_size} {stat.st_mtime_ns}\n")
        cut = tiny.run(*settings, f"at={rng.randint(1, CHANGES)}", "victims=both", f"on_disk={on_disk}")
        count.took_effect += cut.returncode != DONE
        before = finished(tiny.run_dir)
        lost += lose_what_was_not_on_disk(tiny.run_dir, on_disk, rng)
        assert finished(tiny.run_dir) == before
        lock = tiny.run_dir / ".lock"
        if lock.exists():
            then = time.time() - BOOT_S
            lock.write_text(lock.read_text(errors="replace").replace('"boot": "', '"boot": "another-'))
            os.utime(lock, (then, then))
        go_on(tiny, reference, count)
        shutil.rmtree(tiny.folder)
    assert lost > count.faults and count.used_again > 0
    figures(files_that_lost_their_content=lost, **count.figures())
