"""`devrf-pipeline compare`: hold runs against the first, print one table, and write the JSON file."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from devrf.capture.system.durable import write_json
from devrf.capture.system.errors import InputError
from devrf.capture.system.writable import check_file, check_folder
from devrf.pipelines.compare.compared_runs import ComparedRun, find_runs, limits_of
from devrf.pipelines.compare.differing import differing_code, differing_config, differing_versions
from devrf.pipelines.compare.measures import MEASURES, Difference, differences, seed_differences, value_of
from devrf.pipelines.report.run_reader import at
from devrf.pipelines.report.templates import readable
from devrf.pipelines.terminal.console import Talk
from devrf.pipelines.terminal.disk_errors import disk_told
from devrf.pipelines.terminal.tables import print_table
from devrf.reconstruct.evaluation.paired import CONFIDENCE

ROWS = "compare.json"
IN_JSON = ('"not_compared": ', '"differences": ')  # what tells its file from others
WORDS = {"better": "better", "worse": "worse", "open": "cannot be told apart", "same": "the same"}


def compare(talk: Talk, named: Sequence[Path], out: Path, json_path: Path | None) -> None:
    """Compare finished runs of one scene: print what differs, and write it.

    Args:
        talk: Where to speak.
        named: Run folders, scene.yaml files or folders that hold one; the first is what the others are held against.
        out: Folder for compare.json.
        json_path: Another place for it.
    Raises:
        InputError: The runs cannot be compared, or nothing can be written.
        DevrfError: The disk is full.
    """
    rows, option = (out / ROWS, "--out") if json_path is None else (json_path, "--json")
    check_folder(rows.parent, option)
    check_file(rows, option, IN_JSON)
    runs = find_runs(named)
    found = compare_runs(runs)
    with disk_told(f"{option} {rows.parent}", "choose another folder", InputError):
        rows.parent.mkdir(parents=True, exist_ok=True)
    _print(talk, runs, found)
    with disk_told(rows, f"free space, or name another place with {option}"):
        write_json(rows, found)
    talk.say(f"  rows: {rows}")


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


def _print(talk: Talk, runs: Sequence[ComparedRun], found: dict[str, Any]) -> None:
    """The measures as a table, a line for each limit, and what differs besides."""
    print_table(talk, None, ["", *(run.name for run in runs)], _lines(runs, found))
    for name, why in found["not_compared"].items():
        talk.say(f"not compared: {name}: {why}", style="yellow")
    for note in found["notes"]:
        talk.say(f"note: {note}")
    for d in found["by_seed"]:
        groups = f"{', '.join(d['runs'])} against {', '.join(d['against'])}"
        talk.say(f"{groups}, {len(d['seeds'])} seeds: {d['measure']} {_said(d)}")
    for key, values in (found["config"] | found["versions"]).items():
        talk.say(f"{key}: {' | '.join(values)}")


def _lines(runs: Sequence[ComparedRun], found: dict[str, Any]) -> Iterator[list[str]]:
    """Of each measure its name and, of each run, the value with its difference from the first under it."""
    told = {(d["runs"][0], d["measure"]): _said(d) for d in found["differences"]}
    for measure in MEASURES:
        values = [value_of(run, measure) for run in runs]
        if any(value is not None for value in values):
            shown = ["not measured" if v is None else readable(v, measure.digits) for v in values]
            gains = [told.get((run.name, measure.key), "") for run in runs]
            name = f"{measure.name}{f', {measure.unit}' if measure.unit else ''}"
            yield [name, *(f"{v}\n{gain}".strip() for v, gain in zip(shown, gains, strict=True))]


def _said(difference: dict[str, Any]) -> str:
    """The difference and its interval without a unit, and what it is worth: "+0.53 ± 0.21 better"."""
    digits = next(m.digits for m in MEASURES if m.key == difference["measure"])
    words = readable(difference["mean"], digits, sign=True)
    words += "" if difference["half"] is None else f" ± {readable(difference['half'], digits)}"
    if difference["verdict"] is not None:
        return f"{words} {WORDS[difference['verdict']]}"
    return f"{words} too few independent moments" if difference.get("views") else words


def _judged(d: Difference) -> dict[str, Any]:
    about = {"measure": d.measure.key, "unit": d.measure.unit, "low_is_good": d.measure.low_is_good}
    return {"runs": d.runs, "against": d.against, **about, "verdict": d.verdict, **asdict(d.gain)}
