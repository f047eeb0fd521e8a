"""Charts: PSNR, LPIPS and pose error against severity, where the result breaks and where somebody says so.

One per axis, and one of all axes with the PSNR alone.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from devrf.pipelines.bench.stability.axes import AXES, Axis
from devrf.pipelines.bench.stability.case import Result
from devrf.pipelines.bench.stability.points import Points

SIZE_INCHES, DPI = (10.5, 3.4), 120
COLUMNS, SMALL_INCHES = 4, (3.0, 2.1)  # of all axes on one chart, and the size of each
MEASURED, GOOD, STILL, BROKEN, SAID = "#2f6fb3", "#2f8a4f", "0.45", "#b3362f", "#c98a1b"

Value = Callable[[Result], float | None]
PANELS: tuple[tuple[str, Value], ...] = (
    ("PSNR where it moves, dB", lambda r: r.psnr_moving),
    ("LPIPS (VGG)", lambda r: r.lpips),
    ("largest turn of a camera, degrees", lambda r: r.rotation_deg),
)


def axis_chart(
    path: Path, name: str, axis: Axis, results: Sequence[Result], undisturbed: Sequence[Result], found: Points
) -> Path:
    """Draw one axis; severities stand side by side, the undisturbed case first."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    table = figure.subplots(1, len(PANELS))
    for axes, (label, value) in zip(table, PANELS, strict=True):
        _panel(axes, axis, results, undisturbed, found, value)
        axes.set_title(label, fontsize=9)
    _standing_still(table[0], axis, results, undisturbed)
    table[0].legend(fontsize=6.5)
    figure.suptitle(f"{name}: {axis.what}", fontsize=10)
    figure.savefig(path, dpi=DPI)
    return path


def overview_chart(
    path: Path,
    results: Mapping[str, Sequence[Result]],
    undisturbed: Sequence[Result],
    found: Mapping[str, Points],
) -> Path:
    """Draw all axes on one picture, each with its PSNR where it moves; all to the same scale."""
    from matplotlib.figure import Figure

    rows = max(1, -(-len(results) // COLUMNS))
    figure = Figure(figsize=(COLUMNS * SMALL_INCHES[0], rows * SMALL_INCHES[1] + 0.6), layout="constrained")
    table = figure.subplots(rows, COLUMNS, sharey=True, squeeze=False).ravel()
    handles: dict[str, Any] = {}
    for axes, (name, cases) in zip(table, results.items(), strict=False):
        _panel(axes, AXES[name], cases, undisturbed, found[name], PANELS[0][1])
        _standing_still(axes, AXES[name], cases, undisturbed)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.xaxis.label.set_size(7)
        handles |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    for axes in table[len(results) :]:
        axes.set_axis_off()
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=len(handles), fontsize=8
    )
    figure.supylabel(PANELS[0][0], fontsize=9)
    figure.savefig(path, dpi=DPI)
    return path


def _panel(
    axes: Any,
    axis: Axis,
    results: Sequence[Result],
    undisturbed: Sequence[Result],
    found: Points,
    value: Value,
) -> None:
    """One measure of one axis, and both points."""
    places = _places(results)
    _lines(axes, places, results, undisturbed, value)
    for severity, colour, text, style in (
        (found.failure, BROKEN, "breaks: stopped, or no better than standing still", "-"),
        (found.notice, SAID, "health speaks up", "--"),
    ):
        if severity is not None:
            axes.axvline(places.index(severity) + 1, color=colour, linestyle=style, label=text)
    axes.set_xticks(range(len(places) + 1), ["none", *(f"{p:g}" for p in places)])
    axes.set_xlim(-0.4, len(places) + 0.4)
    axes.set_xlabel(axis.unit)
    axes.grid(True, axis="y", alpha=0.3)


def _places(results: Sequence[Result]) -> list[float]:
    """Severities, side by side."""
    return sorted({r.severity for r in results})


def _standing_still(axes: Any, axis: Axis, results: Sequence[Result], undisturbed: Sequence[Result]) -> None:
    """The scene at rest: the undisturbed one, or where something else is filmed that of each severity."""
    label = "standing still (static_baseline)"
    if not axis.films_anew:
        still = _known(undisturbed, lambda r: r.baseline)
        if still:
            axes.axhline(fmean(still), color=STILL, linestyle=":", label=label)
        return
    columns = [list(undisturbed), *([r for r in results if r.severity == p] for p in _places(results))]
    own = {n: v for n, cases in enumerate(columns) if (v := _known(cases, lambda r: r.baseline))}
    axes.plot(list(own), [fmean(v) for v in own.values()], ":", color=STILL, label=label)


def _lines(
    axes: Any, places: Sequence[float], results: Sequence[Result], undisturbed: Sequence[Result], value: Value
) -> None:
    """The means over seeds as a line, seeds as dots; a level line at the undisturbed mean."""
    columns = [list(undisturbed), *([r for r in results if r.severity == p] for p in places)]
    for n, cases in enumerate(columns):
        if all(r.stopped is not None for r in cases):
            axes.annotate(
                "stopped",
                (n, 0.03),
                xycoords=("data", "axes fraction"),
                rotation=90,
                fontsize=7,
                color=BROKEN,
            )
    found = {n: v for n, cases in enumerate(columns) if (v := _known(cases, value))}
    if not found:
        axes.text(0.5, 0.5, "not measured", ha="center", va="center", transform=axes.transAxes, color=STILL)
        return
    axes.plot(list(found), [fmean(v) for v in found.values()], "-o", color=MEASURED, markersize=4)
    for n, values in found.items():
        axes.plot([n] * len(values), values, ".", color=MEASURED, alpha=0.6)
    if 0 in found:
        axes.axhline(fmean(found[0]), color=GOOD, linewidth=0.8, label="undisturbed")


def _known(cases: Sequence[Result], value: Value) -> list[float]:
    return [v for r in cases if (v := value(r)) is not None]
