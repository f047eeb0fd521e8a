"""The report's confidence: where pictures may be wrong, whether they are, and what a crew should film more."""

from pathlib import Path
from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.html import absent, figure, number, section, table, text
from devrf.pipelines.report.pictures import picture_uri, read_picture
from devrf.pipelines.report.run import RunFolder, as_float, at, evenly

METRICS = "evaluate/metrics.json"
KINDS = ("true", "rendered", "confidence", "error")
WIDTH, MAX_VIEWS = 320, 3
CURVES = {"test": "test views", "test_moving": "where it moves", "test_static": "held-out sweep"}
LEAD = (
    "How wrong each pixel is expected to be, from how many cameras see what it shows and how well training pictures "
    "are explained there; never from the true picture. White is sure, an expected PSNR of 40 dB or more; black is "
    "10 dB or less."
)


def confidence_section(run: RunFolder) -> str:
    """Pictures, expected against measured errors, and the subject by the number of cameras that see it."""
    found = run.object(METRICS).get("confidence")
    if not isinstance(found, dict):
        return section("confidence", "How sure the pictures are", LEAD, absent(run.why_absent("evaluate")))
    body = _pictures(run) + _curves(found) + _subject(run, found)
    return section("confidence", "How sure the pictures are", LEAD, body)


def _pictures(run: RunFolder) -> str:
    folder = run.folder("evaluate")
    rows = [row for row in run.objects(METRICS, "per_view") if all(kind in row for kind in KINDS)]
    moving = [row for row in rows if row.get("time") is not None]
    reels = []
    for row in evenly(moving or rows, MAX_VIEWS):
        figures = "".join(_picture(folder, row, kind) for kind in KINDS)
        name = f"{row.get('camera', '')}, frame {row.get('index', '')}"
        reels.append(
            f'<div class="reel wide"><h3>{text(name)}</h3><div class="strip four">{figures}</div></div>'
        )
    return f'<div class="reels">{"".join(reels)}</div>' if reels else ""


def _picture(folder: Path, row: dict[str, Any], kind: str) -> str:
    picture = read_picture(folder / str(row[kind]))
    return "" if picture is None else figure(picture_uri(picture, WIDTH), kind, f"{kind} picture")


def _curves(found: dict[str, Any]) -> str:
    series, rows = [], []
    for n, (key, name) in enumerate(CURVES.items()):
        bins = at(found, f"{key}.bins")
        if not isinstance(bins, list) or not bins:
            continue
        if key == "test_static" and at(found, key) == at(found, "test"):
            continue  # nothing moves: these are the test views
        expected, measured = (
            [as_float(at(part, which)) for part in bins] for which in ("expected_rms", "measured_rms")
        )
        series.append(Series(name, expected, measured, n, markers=True))

        def cell(measure: str, unit: str, digits: int, key: str = key) -> str:
            whole = f"{key}.{measure}"
            return number(at(found, whole), unit, digits, file=METRICS, key=f"confidence.{whole}")

        rows.append(
            [
                text(name), cell("expected_rms", "grey levels", 1), cell("measured_rms", "grey levels", 1),
                cell("spearman", "", 2),
            ]
        )  # fmt: skip
    if not series:
        why = at(found, "test.why") or "nothing to compare with"
        return absent(f"Not compared with true pictures: {why}.")
    ends = [min(x for s in series for x in s.x), max(x for s in series for x in s.x)]
    series.append(Series("as expected", ends, ends, len(series), dashed=True))
    chart = line_chart(series, "expected error, grey levels", "measured error, grey levels")
    head = ("on", "expected", "measured", "rank correlation")
    return (
        f'<h3>Expected and measured</h3><div class="charts one">{chart}</div>'
        f"{table(head, rows, source=METRICS, numeric=range(1, len(head)))}"
        '<p class="source">Each dot is a tenth of the pixels, the surest first.</p>'
    )


def _subject(run: RunFolder, found: dict[str, Any]) -> str:
    """The subject's shares, by how many cameras see them."""
    parts = run.objects(METRICS, "confidence.seen_by")
    lines = []
    for n, part in enumerate(parts):
        key = f"confidence.seen_by.{n}"
        share = number(part.get("share"), "%", 1, file=METRICS, key=f"{key}.share", scale=100.0)
        error = part.get("expected_rms")
        expected = number(error, "grey levels", 1, file=METRICS, key=f"{key}.expected_rms")
        lines.append([text(part.get("cameras", "")), share, expected])
    if not lines:
        return ""
    low = number(found.get("low_above"), "grey levels", 0, file=METRICS, key="confidence.low_above")
    share = number(found.get("low_share"), "%", 0, file=METRICS, key="confidence.low_share", scale=100.0)
    what = "of what moves" if found.get("moves") else "of what is in the box"
    seen_by = (
        "moving cameras that see it" if found.get("moves") else "sweep pictures that see it, of ten or fewer"
    )
    return (
        f"<h3>The subject from all directions of the sweep</h3><p>{share} {what} is of low confidence: an expected "
        f"error above {low}. Let more cameras see it from further apart, and bring the sweep closer to it.</p>"
        f"{table((seen_by, 'share of all', 'expected error'), lines, source=METRICS, numeric=range(3))}"
    )
