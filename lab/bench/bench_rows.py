"""Rows of a benchmark: what was measured, beside what others report and what was aimed at."""

import json
import operator
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.tables import print_table

VERDICTS = {None: "", True: "yes", False: "no"}


@dataclass(frozen=True)
class Row:
    """One measured number.

    Attributes:
        name: What it is, `benchmark/case/metric`.
        value: The number; None where it could not be measured.
        unit: Its unit.
        spread: Standard deviation over seeds; None with fewer than two.
        anchor: What others report for the same thing.
        source: Where the anchor is from, and on which data.
        goal: What was aimed at, at least (at most where `low_is_good`).
        met: Whether it was reached; None where there is no goal or no value.
        why: Why there is no value.
    """

    name: str
    value: float | None
    unit: str
    spread: float | None = None
    anchor: float | None = None
    source: str | None = None
    goal: float | None = None
    met: bool | None = None
    why: str | None = None

    def at_least(self, goal: float | None) -> "Row":
        """The same row judged against a goal; unjudged without one."""
        return self._judged(goal, operator.ge)

    def at_most(self, goal: float | None) -> "Row":
        """The same where little is good."""
        return self._judged(goal, operator.le)

    def _judged(self, goal: float | None, reaches: Callable[[float, float], bool]) -> "Row":
        if goal is None:
            return self
        return replace(self, goal=goal, met=None if self.value is None else reaches(self.value, goal))


def publish(
    talk: Talk,
    title: str | None,
    rows: Sequence[Row],
    path: Path | None,
    chart: Path | None = None,
    **about: Any,
) -> list[Row]:
    """Print the rows (not without a title), write them (not without a path), and say where they and a chart lie."""
    if title is not None:
        print_rows(talk, title, rows)
    if path is not None:
        write_rows(path, rows, **about)
        talk.say(f"  rows: {path}")
    if chart is not None:
        talk.say(f"  chart: {chart}")
    return list(rows)


def write_rows(path: Path, rows: Sequence[Row], **about: Any) -> None:
    """Write `{…about, rows: [{name, value, unit, …}]}`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(about | {"rows": [asdict(row) for row in rows]}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def print_rows(talk: Talk, title: str, rows: Sequence[Row]) -> None:
    """The rows as a table, and where what is published comes from."""
    numbers = ((row, [_number(n) for n in (row.value, row.spread, row.anchor, row.goal)]) for row in rows)
    lines = [
        (row.name, value or "not measured", spread, row.unit, anchor, goal, VERDICTS[row.met])
        for row, (value, spread, anchor, goal) in numbers
    ]
    print_table(talk, title, ("", "value", "±", "unit*", "published", "goal", "met?*"), lines)
    for source in dict.fromkeys(row.source for row in rows if row.source):
        talk.say(f"published: {source}")
    for why in dict.fromkeys(f"{row.name}: {row.why}" for row in rows if row.why):
        talk.say(why)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}" if abs(value) < 1 else f"{value:.2f}"
