"""The report's page of `bench speed`: accuracy against seconds, megabytes and pictures per second."""

from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import link, number, section, table, text
from devrf.pipelines.report.run import RunFolder, as_float

LEAD = (
    "What several ways to train this scene came to. Up is better; left is better but for pictures per second. The "
    "lines lead to the result, measured on a few views on the way."
)
COSTS = (
    ("seconds", "seconds of training"),
    ("megabytes", "megabytes"),
    ("render_fps", "pictures per second"),
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
    cases = [str(case) for case in found["curves"]]
    values = {str(row["name"]): as_float(row.get("value")) for row in rows}
    charts = "".join(_chart(cases, values, found["curves"], cost, label) for cost, label in COSTS)
    body = f'<div class="charts three">{charts}</div>' + _table(cases, rows, place, file)
    device = f'<p class="source">{text(found.get("device", ""))}; {link(file)}</p>'
    return section("speed", "Speed and accuracy", LEAD, body + device)


def _chart(cases: list[str], values: dict[str, float], curves: dict[str, Any], cost: str, label: str) -> str:
    """Results as dots against one cost; against seconds, how training got there as well."""
    series = []
    for n, case in enumerate(cases):
        result, psnr = values.get(f"speed/{case}/{cost}"), values.get(f"speed/{case}/test/psnr")
        if cost == "seconds":
            way = [point for point in curves[case] if isinstance(point, dict)]
            x, y = ([as_float(point.get(axis)) for point in way] for axis in ("seconds", "psnr"))
            series.append(Series("", x, y, n))
        if result is not None and psnr is not None:
            series.append(Series(case, [result], [psnr], n, markers=True))
    return line_chart(series, label, "PSNR of test views, dB", log_x=True, small=True)


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
    return table(head, lines, numeric=range(1, len(head)))
