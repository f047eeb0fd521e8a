"""Charts of benchmarks as PNG files: cases and lines over seeds, each seed a dot; results against their cost."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from devrf.reconstruct.paired import Gain

SIZE_INCHES, DPI = (7.0, 4.2), 130
NAME_OFFSET = 3  # points, of a name from its mark
NEAR_THE_EDGE = 0.75  # share of the axis
WIDE = 6.0  # last over first, from which an axis has places for 1, 2 and 5


def cases(
    path: Path, values: Mapping[str, Sequence[float]], anchors: Mapping[str, float], y_label: str, title: str
) -> Path:
    """Means and single seeds, what others report as diamonds beside them."""
    figure, axes = _figure(y_label, title)
    x = np.arange(len(values))
    means = [float(np.mean(v)) for v in values.values()]
    axes.plot(x, means, "_", markersize=28, markeredgewidth=3, color="#2f6fb3", label="ours, mean")
    for n, (mean, v) in enumerate(zip(means, values.values(), strict=True)):
        axes.plot([n] * len(v), v, ".", color="#1f3d66", label="ours, one seed" if n == 0 else None)
        axes.annotate(f"{mean:.1f}", (n - 0.18, mean), ha="right", va="center", fontsize=9)
    paper = [anchors[name] for name in values]
    axes.plot(x + 0.2, paper, "D", markersize=5, color="#c2662d", label="the paper (other data)")
    axes.set_xticks(x, list(values))
    axes.set_xlim(-0.6, len(values) - 0.4)
    return _saved(figure, axes, path)


def lines(
    path: Path,
    series: Mapping[str, Mapping[int, Sequence[float | None]]],
    x_label: str,
    y_label: str,
    title: str,
) -> Path:
    """Means as lines, seeds as dots."""
    figure, axes = _figure(y_label, title)
    for name, points in series.items():
        found = {x: [v for v in values if v is not None] for x, values in points.items()}
        found = {x: v for x, v in found.items() if v}
        line = axes.plot(list(found), [np.mean(v) for v in found.values()], "-o", label=name)[0]
        for x, v in found.items():
            axes.plot([x] * len(v), v, ".", color=line.get_color())
    axes.set_xticks(sorted({x for points in series.values() for x in points}))
    axes.set_xlabel(x_label)
    return _saved(figure, axes, path)


def gains(path: Path, found: Mapping[str, Mapping[str, Gain]], title: str) -> Path:
    """By name and measure: a bar with its interval and every pair as a dot in a panel per measure."""
    from matplotlib.figure import Figure

    measures = list(dict.fromkeys(m for of in found.values() for m in of))
    figure = Figure(figsize=(3.2 + 3.2 * len(measures), 1.2 + 0.24 * len(found)), layout="constrained")
    row = figure.subplots(1, len(measures), sharey=True, squeeze=False)[0]
    for axes, measure in zip(row, measures, strict=True):
        for n, of in enumerate(found.values()):
            if (gain := of.get(measure)) is not None:
                error = None if gain.half is None else [gain.half]
                axes.barh(n, gain.mean, xerr=error, color="#a9c6e8", ecolor="#2f6fb3", capsize=2, height=0.7)
                axes.plot(gain.by_pair, [n] * len(gain.by_pair), ".", color="#1f3d66", markersize=4)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set_xlabel(measure, fontsize=9)
        axes.grid(True, axis="x", alpha=0.3)
    row[0].set_yticks(range(len(found)), list(found), fontsize=8)
    row[0].invert_yaxis()
    figure.suptitle(title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path


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


def frontier_chart(path: Path, panels: Mapping[str, Mapping[str, Sequence[Curve]]], title: str) -> Path:
    """A row of panels per y label, in it a panel per x label, logarithmic in x."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    first = next(iter(panels.values()))
    figure = Figure(figsize=(4.6 * len(first), 0.8 + 4.2 * len(panels)), layout="constrained")
    table = figure.subplots(len(panels), len(first), sharey="row", sharex="col", squeeze=False)
    names = list(dict.fromkeys(c.name for curves in first.values() for c in curves if c.kind == "ours"))
    colours = {name: colormaps["tab10"](n % 10) for n, name in enumerate(names)}
    for row, (y_label, columns) in zip(table, panels.items(), strict=True):
        row[0].set_ylabel(y_label)
        for axes, (x_label, curves) in zip(row, columns.items(), strict=True):
            axes.set_xscale("log")
            axes.set_xlabel(x_label)
            axes.grid(True, alpha=0.3)
            for curve in curves:
                _draw(axes, curve, colours.get(curve.name, "black"))
            low, high = axes.get_xlim()
            wide = high > WIDE * low
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if wide else MaxNLocator(4))
            axes.xaxis.set_minor_locator(NullLocator())
            axes.xaxis.set_major_formatter("{x:g}")
            _turn_names_inwards(axes)
    handles, labels = table[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)), fontsize=8)
    figure.suptitle(title, fontsize=10)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path


def _draw(axes: Any, curve: Curve, colour: Any) -> None:
    if not curve.points:
        return
    x, y = zip(*curve.points, strict=True)
    if curve.kind == "ours":
        axes.plot(x, y, "o", color=colour, markersize=8, label=curve.name, zorder=3)
    elif curve.kind == "way":
        first = not any(line.get_gid() == "way" for line in axes.get_lines())
        label = "on the way there, a few views" if first else None
        axes.plot(x, y, "-", color=colour, linewidth=1, alpha=0.7, label=label, gid="way")
    elif curve.kind == "front":
        axes.plot(x, y, "--", color="black", linewidth=0.8, label=curve.name, zorder=2)
    else:
        first = not any(line.get_marker() == "x" for line in axes.get_lines())
        label = "published: other data, other device" if first else None
        axes.plot(x, y, "x", color="0.55", markersize=5, label=label)
        axes.annotate(
            curve.name,
            (x[0], y[0]),
            xytext=(NAME_OFFSET, NAME_OFFSET),
            textcoords="offset points",
            fontsize=5.5,
            color="0.45",
        )


def _turn_names_inwards(axes: Any) -> None:
    """Names of marks near the right edge stand before them."""
    to_share = axes.transScale + axes.transLimits
    for text in axes.texts:
        if to_share.transform(text.xy)[0] > NEAR_THE_EDGE:
            text.set(ha="right", position=(-NAME_OFFSET, NAME_OFFSET))


def _figure(y_label: str, title: str) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, layout="constrained")
    axes = figure.subplots()
    axes.set_ylabel(y_label)
    axes.set_title(title, fontsize=10)
    axes.grid(True, axis="y", alpha=0.3)
    return figure, axes


def _saved(figure: Any, axes: Any, path: Path) -> Path:
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path
