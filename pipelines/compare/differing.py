"""What runs differ in besides their measures: configuration, code and libraries, times of stages, health."""

from collections.abc import Sequence
from typing import Any

from devrf.pipelines.compare.runs import ComparedRun
from devrf.pipelines.report.run import at
from devrf.pipelines.report.summary import health_rows

ABSENT = "–"  # a key that this run's version does not know, a stage it does not have
OTHER_FILE = "file {}"  # files are told apart by letters, not by their digests


def differing_config(runs: Sequence[ComparedRun]) -> dict[str, list[str]]:
    """Keys of the configuration in which the runs are not all alike, with each run's value in words."""
    keys = dict.fromkeys(key for run in runs for key in run.config)
    found = {}
    for key in keys:
        values = [run.config.get(key, ABSENT) for run in runs]
        if any(value != values[0] for value in values):
            found[key] = _in_words(values)
    return found


def differing_code(runs: Sequence[ComparedRun]) -> dict[str, list[str]]:
    """Stages that were made by other code than the first run's, each with the files that differ, run by run.

    Without those that only show a result.
    """
    found = {}
    for stage in (stage for stage in runs[0].folder.stages if stage not in ("render", "report")):
        sources = [at(run.stamps.get(stage), "identity.code") for run in runs]
        known = [source if isinstance(source, dict) else {} for source in sources]
        if any(k != known[0] for k in known if k and known[0]):
            found[stage] = [_files_in_words(known[0], k) for k in known]
    return found


def differing_versions(runs: Sequence[ComparedRun]) -> dict[str, list[str]]:
    """Versions of devrf, Python and the libraries, and the device, where they are not all alike."""
    names = dict.fromkeys(name for run in runs for name in at(run.metrics, "versions") or {})
    rows = {name: [str(at(run.metrics, f"versions.{name}") or ABSENT) for run in runs] for name in names}
    rows["device of training"] = [str(at(run.metrics, "train.device") or ABSENT) for run in runs]
    return {name: values for name, values in rows.items() if len(set(values)) > 1}


def stage_times(runs: Sequence[ComparedRun]) -> dict[str, list[float | None]]:
    """Seconds of every stage that at least one of the runs has."""
    stages = [s for s in runs[0].folder.stages if s != "report" and any(s in run.stamps for run in runs)]
    return {stage: [_seconds(run.stamps.get(stage)) for run in runs] for stage in stages}


def differing_health(
    runs: Sequence[ComparedRun],
) -> dict[tuple[str, str], list[tuple[int, dict[str, Any]] | None]]:
    """Checks whose verdict is not the same in all runs: stage and check -> each run's row with its place, or None.

    A check that only some of the runs have differs where it warns or fails; of one that a run has twice the worse
    counts.
    """
    by_run = []
    for run in runs:
        rows: dict[tuple[str, str], tuple[int, dict[str, Any]]] = {}
        for stage in run.folder.stages:
            for n, row in enumerate(health_rows(run.folder, stage)):
                key = stage, str(row.get("check", ""))
                if key not in rows or _badness(row) > _badness(rows[key][1]):
                    rows[key] = n, row
        by_run.append(rows)
    found = {}
    for key in dict.fromkeys(key for rows in by_run for key in rows):
        shown = [rows.get(key) for rows in by_run]
        verdicts = {"ok" if row is None else row[1].get("verdict") for row in shown}
        if len(verdicts) > 1:
            found[key] = shown
    return found


def _badness(row: dict[str, Any]) -> int:
    return {"warn": 1, "fail": 2}.get(str(row.get("verdict")), 0)


def _in_words(values: Sequence[Any]) -> list[str]:
    """Values as people write them; contents of files as letters, the same letter for the same content."""
    contents = list(
        dict.fromkeys(str(v["content"]) for v in values if isinstance(v, dict) and "content" in v)
    )
    letters = {content: OTHER_FILE.format(chr(ord("A") + n % 26)) for n, content in enumerate(contents)}
    return [
        letters[str(v["content"])]
        if isinstance(v, dict) and "content" in v
        else "default"
        if v is None
        else str(v)
        for v in values
    ]


def _files_in_words(base: dict[str, str], other: dict[str, str]) -> str:
    if base == other:
        return "as the first"
    differ = sorted(k for k in base.keys() | other.keys() if base.get(k) != other.get(k))
    return ", ".join(name.removeprefix("devrf.") for name in differ)


def _seconds(stamp: dict[str, Any] | None) -> float | None:
    seconds = at(stamp, "seconds")
    return float(seconds) if isinstance(seconds, (int, float)) else None
