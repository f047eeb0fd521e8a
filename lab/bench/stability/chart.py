"""The chart of all axes: PSNR against severity, where the result breaks and where somebody says so."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from devrf.lab.bench.bench_charts import Curve, Panel, chart, seed_curves
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.case import Result
from devrf.lab.bench.stability.points import Points

COLUMNS, INCHES = 4, (3.0, 2.3)  # of all axes side by side, and the size of each


def axes_chart(
    path: Path,
    results: Mapping[str, Sequence[Result]],
    undisturbed: Sequence[Result],
    found: Mapping[str, Points],
) -> Path:
    """Draw all axes on one picture, each with its PSNR where it moves; all to the same scale.

    Severities stand side by side, the undisturbed case first.
    """
    panels = [_panel(name, cases, undisturbed, found[name]) for name, cases in results.items()]
    rows = [panels[n : n + COLUMNS] for n in range(0, len(panels), COLUMNS)]
    return chart(path, rows, "PSNR where it moves, dB", INCHES, sharey=True)


def _panel(name: str, results: Sequence[Result], undisturbed: Sequence[Result], found: Points) -> Panel:
    """One axis: means and seeds, what is undisturbed and at rest, and both points."""
    places = sorted({r.severity for r in results})
    columns = [list(undisturbed), *([r for r in results if r.severity == p] for p in places)]
    curves = seed_curves("ours", {n: [r.psnr_moving for r in cases] for n, cases in enumerate(columns)})
    whole = seed_curves("", {0: [r.psnr_moving for r in undisturbed]})[0].points
    curves += [
        Curve("undisturbed", [(n, psnr) for n in (0, len(places))], "undisturbed") for _, psnr in whole
    ]
    for kind, severity, text in (
        ("breaks", found.failure, "breaks: stopped, or no better than standing still"),
        ("notice", found.notice, "health speaks up"),
    ):
        if severity is not None:
            curves.append(Curve(text, [(places.index(severity) + 1, 0.0)], kind))
    # The scene at rest: the undisturbed one, or where something else is filmed that of each severity.
    of = columns if AXES[name].films_anew else columns[:1] * len(columns)
    still = seed_curves("", {n: [r.baseline for r in cases] for n, cases in enumerate(of)})[0].points
    curves.append(Curve("standing still (static_baseline)", still, "still"))
    ticks = ["none", *(f"{p:g}" for p in places)]
    stopped = [n for n, cases in enumerate(columns) if all(r.stopped is not None for r in cases)]
    return Panel(curves, AXES[name].unit, title=name, ticks=ticks, notes=dict.fromkeys(stopped, "stopped"))
