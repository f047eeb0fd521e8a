"""One page with what the suite found: a table of all axes, then each axis with its chart and its cases."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from devrf.pipelines.bench.stability.axes import AXES
from devrf.pipelines.bench.stability.case import Result
from devrf.pipelines.bench.stability.heard import SUFFERED_DB, Heard
from devrf.pipelines.bench.stability.points import Points, said
from devrf.pipelines.report.pictures import data_uri
from devrf.pipelines.report.templates import render


def build_page(
    title: str,
    undisturbed: Sequence[Result],
    results: Mapping[str, Sequence[Result]],
    found: Mapping[str, Points],
    known: Heard,
    overview_chart: Path,
    charts: Mapping[str, Path],
    left_out: Mapping[str, str],
) -> str:
    """The page as one text.

    Args:
        title: What was damaged, in words.
        undisturbed: The undisturbed case of every seed.
        results: Axis -> its cases.
        found: Axis -> its failure and notice point.
        known: Precision and recall of what is said.
        overview_chart: Of all axes.
        charts: Axis -> its chart.
        left_out: Axis and severity -> why it was not measured.
    """
    of_seed = {r.seed: r for r in undisturbed}
    cases = {"undisturbed": [(r, said(r, None)) for r in undisturbed]}
    cases |= {name: [(r, said(r, of_seed.get(r.seed))) for r in of] for name, of in results.items()}
    values = {
        "title": title,
        "axes": {name: AXES[name] for name in results},
        "cases": cases,
        "found": found,
        "known": known,
        "suffered_db": SUFFERED_DB,
        "overview": data_uri(overview_chart.read_bytes(), "image/png"),
        "charts": {name: data_uri(charts[name].read_bytes(), "image/png") for name in results},
        "left_out": left_out,
    }
    return render("suite.html", values)
