"""What measures are judged as, by code and what they are about."""

from collections.abc import Iterable

from devrf.capture.measure import Measure
from devrf.pipelines.health.judge import HealthRow, judge


def named(rows: Iterable[HealthRow]) -> dict[str, HealthRow]:
    """Rows by "code about", or by "code" where that says all."""
    return {f"{row.code} {row.about}".strip(): row for row in rows}


def judged(measures: Iterable[Measure]) -> dict[str, HealthRow]:
    """The rows of these measures, by name."""
    return named(judge(measures))


def fired(measures: Iterable[Measure]) -> dict[str, HealthRow]:
    """Those of them that are not ok."""
    return {name: row for name, row in judged(measures).items() if row.verdict != "ok"}
