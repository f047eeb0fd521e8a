"""batch.html: the summary of a batch on one page that needs no other file."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from markupsafe import escape as text

from devrf.pipelines.console import duration

STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem; color: #1b1f24; background: #fff; }
table { border-collapse: collapse; }
th, td { text-align: left; padding: .3rem .8rem; border-bottom: 1px solid #dfe3e8; }
th { color: #5c646d; font-weight: 600; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.done, .ok { color: #1a7a4a; } .failed, .refused, .fail { color: #b8302a; } .unhealthy, .warn { color: #8f5f00; }
.waiting, .stopped { color: #5c646d; } pre { white-space: pre-wrap; margin: 0; font-size: 13px; max-width: 48rem; }
@media (prefers-color-scheme: dark) { body { color: #e7eaed; background: #14171a; } th, td { border-color: #31373e; }
a { color: #78b7fa; } .done, .ok { color: #5cc68f; } .failed, .refused, .fail { color: #ff8078; }
.unhealthy, .warn { color: #e2b550; } }
"""


def page(batch: Mapping[str, Any], folder: Path) -> str:
    """The page of what batch.json holds.

    Args:
        batch: `rows.summary`.
        folder: Where the page will lie; links are relative to it.
    """
    states = ", ".join(f"{count} {state}" for state, count in batch["states"].items())
    stages = list(dict.fromkeys(name for row in batch["scenes"] for name in row["stages"]))
    heads = ["scene", "state", "health", "PSNR", "SSIM", *stages, "nodes", "message"]
    rows = "\n".join(_row(row, stages, folder) for row in batch["scenes"])
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{text(f"batch: {states}")}</title><style>{STYLE}</style></head><body>
<h1>{text(states)}</h1>
<p>Engine {text(batch["engine"])}, begun {text(batch["started"])}, {text(duration(batch["seconds"]))};
exit code {text(batch["code"])}. Times are those of the stages when they were made.</p>
<table><thead><tr>{"".join(f"<th>{text(head)}</th>" for head in heads)}</tr></thead><tbody>
{rows}
</tbody></table></body></html>
"""


def _row(row: Mapping[str, Any], stages: list[str], folder: Path) -> str:
    name = text(row["name"])
    if row["report"] is not None:
        name = f'<a href="{text(os.path.relpath(row["report"], folder))}">{name}</a>'
    numbers = (row["numbers"].get("psnr"), row["numbers"].get("ssim"))
    lost = f" ({row['lost']} lost)" if row["lost"] else ""
    cells = [
        f'<td title="{text(row["scene"])}">{name}</td>',
        f'<td class="{text(row["state"])}">{text(row["state"])}</td>',
        f'<td class="{text(row["verdict"] or "")}">{text(row["verdict"] or "")}</td>',
        *(
            f'<td class="n">{"" if number is None else f"{number:.{digits}f}"}</td>'
            for number, digits in zip(numbers, (2, 3), strict=True)
        ),
        *(_stage(row["stages"].get(stage)) for stage in stages),
        f"<td>{text(', '.join(row['nodes']) + lost)}</td>",
        f"<td><pre>{text(row['message'] or '')}</pre></td>",
    ]
    return f"<tr>{''.join(cells)}</tr>"


def _stage(made: Mapping[str, Any] | None) -> str:
    if made is None or made["seconds"] is None:
        return "<td></td>"
    return f'<td class="n {text(made["verdict"] or "")}">{text(duration(made["seconds"]))}</td>'
