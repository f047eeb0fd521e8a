"""Rows of a benchmark: what was measured, beside what others report and what was aimed at."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from devrf.pipelines.console import Talk

PIPE_WIDTH = 110  # characters, where no terminal says how wide it is


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


def with_goal(row: Row, goal: float, *, low_is_good: bool = False) -> Row:
    """The same row judged against a goal."""
    met = None if row.value is None else (row.value <= goal if low_is_good else row.value >= goal)
    return Row(**(asdict(row) | {"goal": goal, "met": met}))


def write_rows(path: Path, rows: Sequence[Row], **about: Any) -> None:
    """Write `{…about, rows: [{name, value, unit, …}]}`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps(about | {"rows": [asdict(row) for row in rows]}, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")


def print_rows(talk: Talk, title: str, rows: Sequence[Row]) -> None:
    """The rows as a table."""
    if talk.loudness == "quiet":
        return
    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD)
    for heading in ("", "value", "±", "unit", "published", "goal", "met?"):
        left = heading in ("", "unit", "met?")
        table.add_column(heading, justify="left" if left else "right", overflow="fold")
    for row in rows:
        verdict = "" if row.met is None else "yes" if row.met else "no"
        value = "not measured" if row.value is None else _number(row.value)
        table.add_row(
            row.name, value, _number(row.spread), row.unit, _number(row.anchor), _number(row.goal), verdict
        )
    width = None if talk.out.is_terminal else PIPE_WIDTH
    Console(file=talk.out.file, width=width, highlight=False).print(table)
    for source in dict.fromkeys(row.source for row in rows if row.source):
        talk.say(f"published: {source}")
    for why in dict.fromkeys(f"{row.name}: {row.why}" for row in rows if row.why):
        talk.say(why)


def say_files(talk: Talk, rows: Path, chart: Path | None = None) -> None:
    """Where the rows were written, and the chart."""
    talk.say(f"  rows: {rows}")
    if chart is not None:
        talk.say(f"  chart: {chart}")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}" if abs(value) < 1 else f"{value:.2f}"
