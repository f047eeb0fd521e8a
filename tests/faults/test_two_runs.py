"""Several runs started on one folder at the same instant."""

import shutil
from pathlib import Path

from tests.faults.conftest import TinyMaker
from tests.faults.harness import Count, go_on
from tests.faults.tiny_stages import NAMES

from devrf.pipelines.terminal.exit_codes import BAD_INPUT, DONE

TOGETHER = 3


def test_of_several_runs_one_works(new_tiny: TinyMaker, reference: Path, faults: str, figures) -> None:
    count, refused = Count(), 0
    while count.faults < (20 if faults == "full" else 4):
        tiny = new_tiny()
        started = [tiny.start() for _ in range(TOGETHER)]
        ended = [process.end() for process in started]
        made: list[str] = []
        for run in ended:
            said = run.stderr
            assert run.returncode in (DONE, BAD_INPUT), said
            if run.returncode == BAD_INPUT:
                refused += 1
                assert (
                    str(tiny.run_dir) in said and said.endswith("[folder-busy]\n") and said.count("\n") == 1
                ), said
            made += [line.split()[1].rstrip(":") for line in run.stdout.splitlines() if ": runs:" in line]
        count.took_effect += any(run.returncode == BAD_INPUT for run in ended)
        assert made == list(NAMES)  # each stage once, by whichever run
        go_on(tiny, reference, count)
        shutil.rmtree(tiny.folder)
    assert refused > 0
    figures(runs=count.faults * TOGETHER, refused=refused, **count.figures())
