"""`devrf-pipeline compare`: hold runs against the first, print, and write the page and the JSON file."""

import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from devrf.capture.durable import write_json
from devrf.capture.errors import InputError
from devrf.capture.writable import check_file, check_folder
from devrf.pipelines.compare.differing import differing_code, differing_config, differing_versions
from devrf.pipelines.compare.measures import MEASURES, Difference, differences, seed_differences, value_of
from devrf.pipelines.compare.runs import ComparedRun, common_views, find_runs, limits_of
from devrf.pipelines.console import Talk
from devrf.pipelines.disk_told import disk_told
from devrf.pipelines.report.pictures import picture_uri
from devrf.pipelines.report.run import METRICS, at, evenly
from devrf.pipelines.report.templates import MADE_BY, readable, render
from devrf.pipelines.tables import print_table
from devrf.reconstruct.paired import CONFIDENCE

PAGE, ROWS = "compare.html", "compare.json"
IN_JSON = ('"not_compared": ', '"differences": ')  # what tells its file from others
WORDS = {"better": "better", "worse": "worse", "open": "cannot be told apart", "same": "the same"}
WIDTH, MAX_PICTURES, MAX_VIEWS = 480, 48, 8


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
    check_file(out / PAGE, "--out", [MADE_BY])
    check_file(rows, "--json", IN_JSON)
    runs = find_runs(named)
    found = compare_runs(runs)
    for folder, option in ((out, "--out"), (rows.parent, "--json")):
        with disk_told(f"{option} {folder}", "choose another folder", InputError):
            folder.mkdir(parents=True, exist_ok=True)
    table = measures_table(runs, found)
    _print(talk, runs, found, table)
    with disk_told(out / PAGE, "free space, or name another place with --out"):
        new = out / f".{PAGE}.tmp"
        new.write_text(build_page(runs, found, table, out), encoding="utf-8")
        new.replace(out / PAGE)
    with disk_told(rows, "free space, or name another place with --json"):
        write_json(rows, found)
    talk.say(f"  page: {out / PAGE}")
    talk.say(f"  rows: {rows}")
    return out / PAGE


def compare_runs(runs: Sequence[ComparedRun]) -> dict[str, Any]:
    """Hold every run against the first one; what compare.json holds (docs/report.md).

    Raises:
        InputError: Two of them do not show the same scene or share no test view.
    """
    base, *others = runs
    limits = {other.name: limits_of(base, other) for other in others}
    not_compared = {name: why for name, (why, _) in limits.items() if why is not None}
    notes = [note for _, said in limits.values() for note in said]
    if code := differing_code(runs):
        notes.append(f"made by other code than {base.name}'s: {', '.join(code)}")
    of_views = [d for other in others if other.name not in not_compared for d in differences(base, other)]
    of_seeds = [] if not_compared else list(seed_differences(runs))
    return {
        "format": 2,
        "confidence": CONFIDENCE,
        "runs": [
            {
                "name": run.name,
                "path": str(run.folder.path),
                "seed": run.metrics.get("seed"),
                "versions": at(run.metrics, "versions"),
                "measures": {m.key: value_of(run, m) for m in MEASURES},
            }
            for run in runs
        ],
        "not_compared": not_compared,
        "notes": notes,
        "differences": [{"views": len(d.pairs), **_judged(d)} for d in of_views],
        "by_seed": [{"seeds": d.pairs, **_judged(d)} for d in of_seeds],
        "config": differing_config(runs),
        "versions": differing_versions(runs),
    }


def measures_table(
    runs: Sequence[ComparedRun], found: dict[str, Any]
) -> list[tuple[str, list[tuple[str, str, str]]]]:
    """A row for each measure: its name and, of each run, the value, the difference from the first, what it is worth."""
    told = {(d["runs"][0], d["measure"]): d for d in found["differences"]}
    rows = []
    for measure in (m for m in MEASURES if any(value_of(run, m) is not None for run in runs)):
        cells = []
        for run in runs:
            value, d = value_of(run, measure), told.get((run.name, measure.key))
            shown = "not measured" if value is None else readable(value, measure.digits)
            cells.append((shown, *(("", "") if d is None else said(d))))
        rows.append((f"{measure.name}{f', {measure.unit}' if measure.unit else ''}", cells))
    return rows


def said(difference: dict[str, Any]) -> tuple[str, str]:
    """The difference and its interval without a unit ("+0.53 ± 0.21"), and what it is worth, in words."""
    digits = next(m.digits for m in MEASURES if m.key == difference["measure"])
    words = readable(difference["mean"], digits, sign=True)
    words += "" if difference["half"] is None else f" ± {readable(difference['half'], digits)}"
    if difference["verdict"] is not None:
        return words, WORDS[difference["verdict"]]
    return words, "too few independent moments" if difference.get("views") else ""


def build_page(runs: Sequence[ComparedRun], found: dict[str, Any], table: Sequence[Any], out: Path) -> str:
    """The page as one text; as many views are shown as keep it small."""
    keys = [k for moving in (True, False) for k in common_views(*(run.views[moving] for run in runs))]
    views = []
    for key in evenly(keys, min(MAX_VIEWS, max(1, MAX_PICTURES // (1 + len(runs))))):
        shown = [("true", runs[0].picture(key, "true"))] + [
            (run.name, run.picture(key, "rendered")) for run in runs
        ]
        pictures = [(picture_uri(picture, WIDTH), word) for word, picture in shown if picture is not None]
        views.append((f"{key[0]}, frame {key[1]}", pictures))
    files = [run.folder.path / "report/index.html" for run in runs]
    files = [f if f.is_file() else run.folder.path / METRICS for f, run in zip(files, runs, strict=True)]
    links = [os.path.relpath(file, out.resolve().parent) for file in files]
    seeds = [(d, *said(d)) for d in found["by_seed"]]
    title = " · ".join(run.name for run in runs)
    values = {"title": title, "found": found, "table": table, "views": views, "links": links, "seeds": seeds}
    return render("compare.html", values)


def _print(talk: Talk, runs: Sequence[ComparedRun], found: dict[str, Any], rows: Sequence[Any]) -> None:
    """The measures as a table, a line for each limit, and what differs in the configuration."""
    lines = [(name, *(f"{v}\n{gain} {words}".strip() for v, gain, words in cells)) for name, cells in rows]
    print_table(talk, None, ["", *(run.name for run in runs)], lines)
    for name, why in found["not_compared"].items():
        talk.say(f"not compared: {name}: {why}", style="yellow")
    for note in found["notes"]:
        talk.say(f"note: {note}")
    for d in found["by_seed"]:
        groups = f"{', '.join(d['runs'])} against {', '.join(d['against'])}"
        talk.say(f"{groups}, {len(d['seeds'])} seeds: {d['measure']} {' '.join(said(d))}")
    for key, values in found["config"].items():
        talk.say(f"{key}: {' | '.join(values)}")


def _judged(d: Difference) -> dict[str, Any]:
    about = {"measure": d.measure.key, "unit": d.measure.unit, "low_is_good": d.measure.low_is_good}
    return {"runs": d.runs, "against": d.against, **about, "verdict": d.verdict, **asdict(d.gain)}
