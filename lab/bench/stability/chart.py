"""The chart of all axes: PSNR against severity, where the result breaks and where somebody says so."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from devrf.lab.bench.stability.axes import AXES, Axis
from devrf.lab.bench.stability.case import Result
from devrf.lab.bench.stability.points import Points

DPI, COLUMNS, SMALL_INCHES = 120, 4, (3.0, 2.1)  # of all axes side by side, and the size of each
MEASURED, GOOD, STILL, BROKEN, SAID = "#2f6fb3", "#2f8a4f", "0.45", "#b3362f", "#c98a1b"


def axes_chart(
    path: Path,
    results: Mapping[str, Sequence[Result]],
    undisturbed: Sequence[Result],
    found: Mapping[str, Points],
) -> Path:
    """Draw all axes on one picture, each with its PSNR where it moves; all to the same scale.

    Severities stand side by side, the undisturbed case first.
    """
    from matplotlib.figure import Figure

    rows = max(1, -(-len(results) // COLUMNS))
    figure = Figure(figsize=(COLUMNS * SMALL_INCHES[0], rows * SMALL_INCHES[1] + 0.6), layout="constrained")
    table = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).ravel()
    handles: dict[str, Any] = {}
    for axes, (name, cases) in zip(table, results.items(), strict=False):
        _panel(axes, AXES[name], cases, undisturbed, found[name])
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(7)
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    for axes in table[len(results) :]:
        axes.set_axis_off()
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=len(handles), fontsize=8
    )
    figure.supylabel("PSNR where it moves, dB", fontsize=9)
    figure.savefig(path, dpi=DPI)
    return path


def _panel(
    axes: Any, axis: Axis, results: Sequence[Result], undisturbed: Sequence[Result], found: Points
) -> None:
    """One axis: the means over seeds as a line, seeds as dots, what is undisturbed and at rest, and both points."""
    places = sorted({r.severity for r in results})
    columns = [list(undisturbed), *([r for r in results if r.severity == p] for p in places)]
    for n, cases in enumerate(columns):
        if all(r.stopped is not None for r in cases):
            place = {"xycoords": ("data", "axes fraction"), "rotation": 90}
            axes.annotate("stopped", (n, 0.03), fontsize=7, color=BROKEN, **place)
    psnr = _known(columns, lambda r: r.psnr_moving)
    axes.plot(list(psnr), [fmean(v) for v in psnr.values()], "-o", color=MEASURED, markersize=4)
    for n, values in psnr.items():
        axes.plot([n] * len(values), values, ".", color=MEASURED, alpha=0.6)
    if 0 in psnr:
        axes.axhline(fmean(psnr[0]), color=GOOD, linewidth=0.8, label="undisturbed")
    for severity, colour, text, style in (
        (found.failure, BROKEN, "breaks: stopped, or no better than standing still", "-"),
        (found.notice, SAID, "health speaks up", "--"),
    ):
        if severity is not None:
            axes.axvline(places.index(severity) + 1, color=colour, linestyle=style, label=text)
    # The scene at rest: the undisturbed one, or where something else is filmed that of each severity.
    still = _known(columns if axis.films_anew else columns[:1] * len(columns), lambda r: r.baseline)
    label = "standing still (static_baseline)"
    axes.plot(list(still), [fmean(v) for v in still.values()], ":", color=STILL, label=label)
    axes.set_xticks(range(len(places) + 1), ["none", *(f"{p:g}" for p in places)])
    axes.set_xlim(-0.4, len(places) + 0.4)
    axes.set_xlabel(axis.unit)
    axes.grid(True, axis="y", alpha=0.3)


def _known(
    columns: Sequence[Sequence[Result]], value: Callable[[Result], float | None]
) -> dict[int, list[float]]:
    """A measure by column, of those cases that have it; columns without any are left out."""
    found = {n: [v for r in cases if (v := value(r)) is not None] for n, cases in enumerate(columns)}
    return {n: values for n, values in found.items() if values}
