"""`devrf-pipeline status`: each stage fresh, stale (and why) or missing; its time and its health."""

from pathlib import Path
from typing import TYPE_CHECKING

from devrf.pipelines.runner.standing import Standing
from devrf.pipelines.terminal.console import COLOUR, describe, duration

if TYPE_CHECKING:
    from rich.console import Console

    from devrf.pipelines.config.scene import SceneConfig

STYLE = {"fresh": "green", "stale": "yellow", "missing": "red", "not applicable": "dim"}


def status_dict(config: "SceneConfig", run_dir: Path, found: list[Standing]) -> dict:
    """What `status --json` prints."""
    return {
        "name": config.name,
        "preset": config.preset,
        "output": str(run_dir),
        "stages": [
            {
                "stage": now.stage.name,
                "state": now.state,
                "why": list(now.why),
                "seconds": now.seconds,
                "verdict": now.verdict,
                "health": [row.as_dict() for row in now.health],
                "error": now.error,
            }
            for now in found
        ],
    }


def print_status(console: "Console", config: "SceneConfig", run_dir: Path, found: list[Standing]) -> None:
    """The table for people, then what is not healthy."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=f"{config.name}, preset {config.preset}: {run_dir}", title_justify="left")
    for column in ("stage", "state", "why", "time", "health"):
        table.add_column(column, overflow="fold")
    for now in found:
        verdict = now.verdict
        why = [*now.why, *([f"last try failed: {now.error}"] if now.error else [])]
        table.add_row(
            now.stage.name,
            f"[{STYLE[now.state]}]{now.state}[/]",
            escape("; ".join(why)),
            "" if now.seconds is None else duration(now.seconds),
            "" if verdict is None else f"[{COLOUR[verdict]}]{verdict}[/]",
        )
    console.print(table)
    for now in found:
        for row in now.health:
            if row.verdict != "ok":
                console.print(f"[{COLOUR[row.verdict]}]{now.stage.name}: {escape(describe(row))}[/]")
