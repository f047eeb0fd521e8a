"""`devrf-pipeline compare`: read the runs, hold them against the first, print, and write the page and the JSON file."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from devrf.capture.durable import write_json
from devrf.capture.errors import DevrfError, InputError
from devrf.capture.writable import check_file, check_folder
from devrf.pipelines.bench.rows import PIPE_WIDTH
from devrf.pipelines.compare.differing import differing_config
from devrf.pipelines.compare.measures import Measure, value_of
from devrf.pipelines.compare.page import build_page, judged, said
from devrf.pipelines.compare.result import Comparison, as_json, compare_runs
from devrf.pipelines.compare.runs import ComparedRun, find_runs
from devrf.pipelines.console import Talk
from devrf.pipelines.report.html import readable

PAGE, ROWS = "compare.html", "compare.json"


def compare(talk: Talk, named: Sequence[Path], out: Path, json_path: Path | None) -> Path:
    """Compare finished runs of one scene and say where the page is.

    Args:
        talk: Where to speak.
        named: Run folders, scene.yaml files or folders that hold one; the first is what the others are held against.
        out: Folder for the page.
        json_path: For programs; None: beside the page.
    Raises:
        InputError: The runs cannot be compared, or nothing can be written.
        DevrfError: The disk is full.
    """
    rows = json_path or out / ROWS
    check_folder(out, "--out")
    check_file(out / PAGE, "--out")
    check_file(rows, "--json")
    runs = find_runs(named)
    found = compare_runs(runs, out.resolve())
    for folder, option in ((out, "--out"), (rows.parent, "--json")):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{option} {folder}: cannot be made ({error.strerror or error}); choose another folder"
            ) from None
    _print(talk, found)
    html, where = build_page(found), out / PAGE
    try:
        new = out / f".{PAGE}.tmp"
        new.write_text(html, encoding="utf-8")
        new.replace(out / PAGE)
        where = rows
        write_json(rows, _finite(as_json(found)))
    except OSError as error:
        raise DevrfError(
            f"{where}: cannot be written ({error.strerror or error}); free space, or name another place with --out "
            "or --json"
        ) from None
    talk.say(f"  page: {out / PAGE}")
    talk.say(f"  rows: {rows}")
    return out / PAGE


def _print(talk: Talk, found: Comparison) -> None:
    """The measures as a table, a line for each difference, and what differs in the configuration."""
    if talk.loudness == "quiet":
        return
    base, *others = found.runs
    table = Table(box=SIMPLE_HEAD)
    table.add_column("")
    for run in found.runs:
        table.add_column(run.name, justify="right", overflow="fold")
    for measure in found.measures:
        cells = [_shown(base, measure)]
        for run in others:
            difference = found.of(run, measure)
            more = "" if difference is None else f"\n{said(difference)} {judged(difference)}".rstrip()
            cells.append(_shown(run, measure) + more)
        table.add_row(f"{measure.name}{f', {measure.unit}' if measure.unit else ''}", *cells)
    width = None if talk.out.is_terminal else PIPE_WIDTH
    Console(file=talk.out.file, width=width, highlight=False).print(table)
    for name, why in found.not_compared.items():
        talk.say(f"not compared: {name}: {why}", style="yellow")
    for note in found.notes:
        talk.say(f"note: {note}")
    for d in found.by_seed:
        groups = f"{', '.join(d.groups[1])} against {', '.join(d.groups[0])}"
        talk.say(f"{groups}, {len(d.seeds)} seeds: {d.measure.name} {said(d)} {d.measure.unit} {judged(d)}")
    for key, values in differing_config(found.runs).items():
        talk.say(f"{key}: {' | '.join(values)}")


def _shown(run: ComparedRun, measure: Measure) -> str:
    value = value_of(run, measure)
    return "not measured" if value is None else readable(value, measure.digits)


def _finite(value: Any) -> Any:
    """The same without numbers that JSON does not have; a run's files may hold some."""
    if isinstance(value, dict):
        return {str(key): _finite(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
