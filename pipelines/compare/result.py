"""What a comparison found, for the page, the JSON file and the console."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from devrf.pipelines.compare.differing import (
    differing_code,
    differing_config,
    differing_health,
    differing_versions,
    stage_times,
)
from devrf.pipelines.compare.measures import (
    Difference,
    Measure,
    SeedDifference,
    differences,
    measured,
    repeats,
    seed_differences,
    value_of,
)
from devrf.pipelines.compare.runs import ComparedRun
from devrf.pipelines.compare.same_views import limits_of
from devrf.pipelines.report.html import link
from devrf.pipelines.report.run import at
from devrf.reconstruct.paired import CONFIDENCE, Gain

FORMAT = 1


@dataclass(frozen=True)
class Comparison:
    """Several runs, each against the first.

    Attributes:
        runs: The runs; the first is what the others are held against.
        page_dir: Folder that the page will lie in; links are relative to it.
        not_compared: Run -> why none of its measures is held against the first run's.
        notes: What limits the comparison.
        differences: All that could be compared.
        by_seed: Groups of repeated runs against the first group.
    """

    runs: Sequence[ComparedRun]
    page_dir: Path
    not_compared: dict[str, str]
    notes: list[str]
    differences: list[Difference]
    by_seed: list[SeedDifference]

    @cached_property
    def measures(self) -> list[Measure]:
        """Measures that at least one run has."""
        return measured(self.runs)

    def of(self, run: ComparedRun, measure: Measure) -> Difference | None:
        """The difference of a run from the first in a measure, where there is one."""
        return next((d for d in self.differences if d.run == run.name and d.measure == measure), None)

    def file(self, run: ComparedRun, file: str) -> str:
        """A run's file as the page's links name it: relative to the folder above the page's."""
        return os.path.relpath(run.folder.path / file, self.page_dir.parent)

    def link(self, run: ComparedRun, file: str) -> str:
        """A link to a run's file that names the run."""
        return link(self.file(run, file), f"{run.name}/{file}")


def compare_runs(runs: Sequence[ComparedRun], page_dir: Path) -> Comparison:
    """Hold every run against the first one.

    Raises:
        InputError: Two of them do not show the same scene or share no test view.
    """
    base, *others = runs
    not_compared, notes, found = {}, [], []
    for other in others:
        why, limits = limits_of(base, other)
        notes += limits
        if why is None:
            found += differences(base, other)
        else:
            not_compared[other.name] = why
    by_seed = [] if not_compared else seed_differences(runs)
    return Comparison(runs, page_dir, not_compared, notes, found, by_seed)


def as_json(found: Comparison) -> dict[str, Any]:
    """The comparison for programs (docs/report.md)."""
    runs = found.runs
    return {
        "format": FORMAT,
        "confidence": CONFIDENCE,
        "runs": [
            {
                "name": run.name,
                "path": str(run.folder.path),
                "seed": run.metrics.get("seed"),
                "versions": at(run.metrics, "versions"),
                "measures": {m.key: value_of(run, m) for m in found.measures},
            }
            for run in runs
        ],
        "repeats": [[run.name for run in group] for group in repeats(runs)],
        "not_compared": found.not_compared,
        "notes": found.notes,
        "differences": [
            {"run": d.run, "against": runs[0].name, "views": d.views, **_judged(d.measure, d.gain, d.verdict)}
            for d in found.differences
        ],
        "by_seed": [
            {"groups": d.groups, "seeds": d.seeds, **_judged(d.measure, d.gain, d.verdict)}
            for d in found.by_seed
        ],
        "config": differing_config(runs),
        "code": differing_code(runs),
        "versions": differing_versions(runs),
        "stage_seconds": stage_times(runs),
        "health": [
            {"stage": stage, "check": check, "rows": [None if row is None else row[1] for row in shown]}
            for (stage, check), shown in differing_health(runs).items()
        ],
    }


def _judged(measure: Measure, gain: Gain, verdict: str | None) -> dict[str, Any]:
    return {
        "measure": measure.key,
        "unit": measure.unit,
        "low_is_good": measure.low_is_good,
        "verdict": verdict,
        **asdict(gain),
    }
