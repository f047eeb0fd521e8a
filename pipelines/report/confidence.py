"""Confidence for the report: where pictures may be wrong, whether they are, and what a crew should film more."""

from typing import Any

from devrf.pipelines.report.charts import Series, line_chart
from devrf.pipelines.report.pictures import file_uri
from devrf.pipelines.report.run import METRICS, RunFolder, as_float, at, evenly

KINDS = ("true", "rendered", "confidence", "error")
WIDTH, MAX_VIEWS = 320, 3
CURVES = {"test": "test views", "test_moving": "where it moves", "test_static": "held-out sweep"}


def confidence(run: RunFolder) -> dict[str, Any]:
    """Pictures of a few views, expected against measured errors, and the subject by how many cameras see it."""
    found = run.object(METRICS, "confidence")
    curves = {key: name for key, name in CURVES.items() if isinstance(at(found, key, "bins"), list)}
    if at(found, "test_static") == at(found, "test"):
        curves.pop("test_static", None)  # nothing moves: these are the test views
    series = []
    for n, (key, name) in enumerate(curves.items()):
        bins = [part for part in found[key]["bins"] if isinstance(part, dict)]
        expected, measured = (
            [as_float(part.get(which)) for part in bins] for which in ("expected_rms", "measured_rms")
        )
        series.append(Series(name, expected, measured, n, markers=True))
    values = [x for s in series for x in s.x]
    if values:
        ends = [min(values), max(values)]
        series.append(Series("as expected", ends, ends, len(series), dashed=True))
    return {
        "found": found,
        "curves": curves,
        "chart": line_chart(series, "expected error, grey levels", "measured error, grey levels"),
        "seen_by": run.objects(METRICS, "confidence", "seen_by"),
        "pictures": _pictures(run),
    }


def _pictures(run: RunFolder) -> list[tuple[str, list[tuple[str, str]]]]:
    rows = [row for row in run.objects(METRICS, "per_view") if all(kind in row for kind in KINDS)]
    moving = [row for row in rows if row.get("time") is not None]
    folder = run.folder("evaluate")
    return [
        (
            f"{row.get('camera', '')}, frame {row.get('index', '')}",
            [(file_uri(folder / str(row[kind]), WIDTH), kind) for kind in KINDS],
        )
        for row in evenly(moving or rows, MAX_VIEWS)
    ]
