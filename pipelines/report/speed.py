"""The report's page of `bench speed`: accuracy against seconds, megabytes and pictures per second."""

from typing import Any

from devrf.pipelines.report.html import figure, number, section, table, text
from devrf.pipelines.report.pictures import data_uri
from devrf.pipelines.report.run import RunFolder

LEAD = (
    "What several ways to train this scene came to. A dashed line joins those that no other beats; published figures "
    "are of other data and other devices."
)
COLUMNS = (
    ("test/psnr", "PSNR, test views", "dB", 2),
    ("test/lpips_vgg", "LPIPS", "", 4),
    ("seconds", "training", "s", 0),
    ("megabytes", "model", "MB", 1),
    ("render_fps", "rendering", "fps", 2),
)


def speed_section(run: RunFolder) -> str:
    """Chart and table of the benchmark beside the run folder; empty where none has been made."""
    file = f"../{run.path.name}-bench/speed.json"
    found = run.object(file)
    rows = found.get("rows")
    if not isinstance(rows, list) or not isinstance(found.get("curves"), dict):
        return ""
    place = {str(row["name"]): n for n, row in enumerate(rows)}
    body = _chart(run, file) + _table(list(found["curves"]), rows, place, file)
    return section(
        "speed", "Speed and accuracy", LEAD, f'{body}<p class="source">{text(found.get("device", ""))}</p>'
    )


def _chart(run: RunFolder, file: str) -> str:
    chart = (run.path / file).with_suffix(".png")
    if not chart.is_file():
        return ""
    picture = data_uri(chart.read_bytes(), "image/png")
    return figure(picture, "Up is better; left is better but for rendering.", "accuracy against cost")


def _table(cases: list[str], rows: list[dict[str, Any]], place: dict[str, int], file: str) -> str:
    lines = []
    for case in cases:
        cells = [f"<strong>{text(case)}</strong>"]
        for key, _, unit, digits in COLUMNS:
            n = place.get(f"speed/{case}/{key}")
            row = rows[n] if n is not None else {}
            why = str(row.get("why") or "")
            cells.append(number(row.get("value"), unit, digits, file=file, key=f"rows.{n}.value", why=why))
        lines.append(cells)
    head = ("way to train", *(heading for _, heading, _, _ in COLUMNS))
    return table(head, lines, source=file, numeric=range(1, len(head)))
