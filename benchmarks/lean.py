"""How heavy the program is to work with: start-up, a run in which nothing is stale, trainings beside others.

    python benchmarks/lean.py RUN_SCENE --json benchmarks/results/lean-cpu.json [--skip starts,beside]

RUN_SCENE is the scene.yaml of a run that is finished, the example's (`make demo`); it is copied, not changed. Nothing
else should run meanwhile. Quarter of an hour; the trainings beside a busy program are most of it.
"""

import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from script import arguments, finish

from devrf.lab.bench.bench_rows import Row

PROGRAM = [sys.executable, "-m", "devrf.pipelines.cli.main"]
STARTS = 5
BUSY = "while True: pass"


def main() -> None:
    """Measure, print and write."""
    asked = arguments(__doc__, "scene", skip="")
    rows = [
        *(() if "starts" in asked.skip else _starts(asked.scene)),
        *(() if "beside" in asked.skip else _beside(asked.scene)),
    ]
    finish("lean", rows, asked.json)


def _starts(scene: Path) -> list[Row]:
    """Seconds of `--help` and of a run that has nothing to do: medians, the first of each not counted."""
    help_s = statistics.median([_seconds([*PROGRAM, "--help"]) for _ in range(1 + STARTS)][1:])
    fresh = [*PROGRAM, "run", str(scene), "--preset", "tiny", "--quiet"]
    fresh_s = statistics.median([_seconds(fresh) for _ in range(1 + STARTS)][1:])
    return [Row("lean/help", help_s, "s").at_most(0.4), Row("lean/nothing_stale", fresh_s, "s").at_most(1.0)]


def _beside(scene: Path) -> list[Row]:
    """The two trainings beside a program that keeps one core busy, against alone."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "session"
        shutil.copytree(scene.parent, copy)
        options = "--preset tiny --quiet --until deformation --force canonical --force deformation"
        trainings = [*PROGRAM, "run", str(copy / scene.name), *options.split()]
        alone_s = _seconds(trainings)
        with _busy():
            beside_s = _seconds(trainings)
    return [Row("lean/beside_over_alone", beside_s / alone_s, "times").at_most(2.2)]


@contextmanager
def _busy() -> Iterator[None]:
    """One core kept busy."""
    program = subprocess.Popen([sys.executable, "-c", BUSY])
    try:
        yield
    finally:
        program.kill()
        program.wait()


def _seconds(command: list[str]) -> float:
    """Wall-clock seconds of a command, which has to succeed."""
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


if __name__ == "__main__":
    main()
