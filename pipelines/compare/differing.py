"""What runs differ in besides their measures: configuration, libraries and code."""

from collections.abc import Sequence
from typing import Any

from devrf.pipelines.compare.compared_runs import ComparedRun
from devrf.pipelines.report.run_reader import at

ABSENT = "–"  # a key that this run's version does not know


def differing_config(runs: Sequence[ComparedRun]) -> dict[str, list[str]]:
    """Keys of the configuration in which the runs are not all alike, with each run's value in words."""
    keys = dict.fromkeys(key for run in runs for key in run.config)
    return _unlike({key: [_in_words(run.config.get(key, ABSENT)) for run in runs] for key in keys})


def differing_versions(runs: Sequence[ComparedRun]) -> dict[str, list[str]]:
    """Versions of devrf, Python and the libraries, and the device, where they are not all alike."""
    names = dict.fromkeys(name for run in runs for name in at(run.metrics, "versions") or {})
    rows = {name: [str(at(run.metrics, "versions", name) or ABSENT) for run in runs] for name in names}
    rows["device of training"] = [str(at(run.metrics, "train.device") or ABSENT) for run in runs]
    return _unlike(rows)


def differing_code(runs: Sequence[ComparedRun]) -> list[str]:
    """Stages that were made by other code than the first run's, but for those that only show a result."""
    stages = [stage for stage in runs[0].folder.stages if stage not in ("render", "report")]
    made_by = {stage: [at(run.stamps.get(stage), "identity.rooms") for run in runs] for stage in stages}
    return [
        stage for stage, (first, *others) in made_by.items() if any(o != first for o in others if o and first)
    ]


def _unlike(rows: dict[str, list[str]]) -> dict[str, list[str]]:
    return {key: values for key, values in rows.items() if len(set(values)) > 1}


def _in_words(value: Any) -> str:
    """A value as people write it; of a file the beginning of its digest, the same for the same content."""
    if isinstance(value, dict) and "content" in value:
        return f"file {str(value['content'])[:8]}"
    return "default" if value is None else str(value)
