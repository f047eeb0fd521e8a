"""Charts of benchmarks as PNG files: cases and lines over seeds, each seed a dot; results against their cost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from devrf.reconstruct.paired import Gain

SIZE_INCHES, DPI = (7.0, 4.2), 130
NAME_OFFSET = 3  # points, of a name from its mark
WIDE = 6.0  # last over first, from which an axis has places for 1, 2 and 5
OURS, OUR_SEEDS, THEIRS = "#2f6fb3", "#1f3d66", "#c2662d"


def cases(
    path: Path, values: Mapping[str, Sequence[float]], anchors: Mapping[str, float], y_label: str, title: str
) -> Path:
    """Means and single seeds, what others report as diamonds beside them."""
    figure, ((axes,),) = _figure(title, 1, 1, SIZE_INCHES)
    axes.set_ylabel(y_label)
    means = [float(np.mean(v)) for v in values.values()]
    axes.plot(means, "_", markersize=28, markeredgewidth=3, color=OURS, label="ours, mean")
    for n, (mean, v) in enumerate(zip(means, values.values(), strict=True)):
        axes.plot([n] * len(v), v, ".", color=OUR_SEEDS, label="ours, one seed" if n == 0 else None)
        axes.annotate(f"{mean:.1f}", (n - 0.18, mean), ha="right", va="center", fontsize=9)
    places = np.arange(len(values))
    paper = [anchors[name] for name in values]
    axes.plot(places + 0.2, paper, "D", markersize=5, color=THEIRS, label="the paper (other data)")
    axes.set_xticks(places, list(values))
    axes.set_xlim(-0.6, len(values) - 0.4)
    axes.legend(fontsize=8)
    return _saved(figure, path)


def lines(
    path: Path,
    series: Mapping[str, Mapping[int, Sequence[float | None]]],
    x_label: str,
    y_label: str,
    title: str,
) -> Path:
    """Means as lines, seeds as dots."""
    figure, ((axes,),) = _figure(title, 1, 1, SIZE_INCHES)
    axes.set(xlabel=x_label, ylabel=y_label, xticks=sorted({x for of in series.values() for x in of}))
    for name, points in series.items():
        found = {x: v for x, values in points.items() if (v := [one for one in values if one is not None])}
        line = axes.plot(list(found), [np.mean(v) for v in found.values()], "-o", label=name)[0]
        for x, v in found.items():
            axes.plot([x] * len(v), v, ".", color=line.get_color())
    axes.legend(fontsize=8)
    return _saved(figure, path)


def gains(path: Path, found: Mapping[str, Mapping[str, Gain]], title: str) -> Path:
    """By name and measure: a bar with its interval and every pair as a dot in a panel per measure."""
    measures = list(dict.fromkeys(m for of in found.values() for m in of))
    size = (3.2 + 3.2 * len(measures), 1.2 + 0.24 * len(found))
    figure, (row,) = _figure(title, 1, len(measures), size, sharey=True)
    for axes, measure in zip(row, measures, strict=True):
        for n, gain in enumerate(of.get(measure) for of in found.values()):
            if gain is not None:
                error = None if gain.half is None else [gain.half]
                axes.barh(n, gain.mean, xerr=error, color="#a9c6e8", ecolor=OURS, capsize=2, height=0.7)
                axes.plot(gain.by_pair, [n] * len(gain.by_pair), ".", color=OUR_SEEDS, markersize=4)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel(measure, fontsize=9)
    row[0].set_yticks(range(len(found)), list(found), fontsize=8)
    row[0].invert_yaxis()
    return _saved(figure, path)


@dataclass(frozen=True)
class Curve:
    """Points of one name in a chart.

    Attributes:
        name: In the legend; the same name has the same colour in every panel.
        points: (x, y).
        kind: `ours`: a result; `way`: how training got there; `front`: the results that no other beats;
            `published`: what others report.
    """

    name: str
    points: Sequence[tuple[float, float]]
    kind: Literal["ours", "way", "front", "published"]


MARKS: dict[str, tuple[str, dict[str, Any]]] = {
    "ours": ("o", {"markersize": 8, "zorder": 3}),
    "way": ("-", {"linewidth": 1, "alpha": 0.7}),
    "front": ("--", {"color": "black", "linewidth": 0.8, "zorder": 2}),
    "published": ("x", {"color": "0.55", "markersize": 5}),
}
LABELS = {"way": "on the way there, a few views", "published": "published: other data, other device"}
"""Of kinds that stand in the legend once, whatever their names are."""


def frontier_chart(path: Path, panels: Mapping[str, Mapping[str, Sequence[Curve]]], title: str) -> Path:
    """A row of panels per y label, in it a panel per x label, logarithmic in x."""
    from matplotlib import colormaps
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    first = next(iter(panels.values()))
    size = (4.6 * len(first), 0.8 + 4.2 * len(panels))
    figure, table = _figure(title, len(panels), len(first), size, sharey="row", sharex="col")
    names = list(dict.fromkeys(c.name for curves in first.values() for c in curves if c.kind == "ours"))
    colours = {name: colormaps["tab10"](n % 10) for n, name in enumerate(names)}
    for row, (y_label, columns) in zip(table, panels.items(), strict=True):
        row[0].set_ylabel(y_label)
        for axes, (x_label, curves) in zip(row, columns.items(), strict=True):
            axes.set_xscale("log")
            axes.set_xlabel(x_label)
            for curve in curves:
                _draw(axes, curve, colours.get(curve.name))
            low, high = axes.get_xlim()
            wide = high > WIDE * low
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if wide else MaxNLocator(4))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter("{x:g}")
    legend = dict(zip(*reversed(table[0][0].get_legend_handles_labels()), strict=True))
    columns = min(5, len(legend))
    figure.legend(legend.values(), legend.keys(), loc="outside lower center", ncols=columns, fontsize=8)
    return _saved(figure, path)


def _draw(axes: Any, curve: Curve, colour: Any) -> None:
    style, look = MARKS[curve.kind]
    look = {"color": colour, "label": LABELS.get(curve.kind, curve.name)} | look
    if curve.points:
        axes.plot(*zip(*curve.points, strict=True), style, **look)
    if curve.kind == "published":
        offset = {"xytext": (NAME_OFFSET, NAME_OFFSET), "textcoords": "offset points"}
        axes.annotate(curve.name, curve.points[0], fontsize=5.5, color="0.45", **offset)


def _figure(title: str, rows: int, columns: int, size: tuple[float, float], **shared: Any) -> tuple[Any, Any]:
    """A figure, and its axes row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title, fontsize=10)
    table = figure.subplots(rows, columns, squeeze=False, **shared)
    for axes in table.flat:
        axes.grid(True, alpha=0.3)
    return figure, table


def _saved(figure: Any, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path
