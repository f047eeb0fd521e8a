"""Charts of benchmarks as PNG files: panels of curves, one legend for all of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any

PANEL_INCHES, DPI = (7.0, 4.2), 130
SMALL_INCHES = (4.6, 4.2)  # where several panels stand side by side
NAME_OFFSET = 3  # points, of a name from its mark
WIDE = 6.0  # last over first, from which a logarithmic axis has places for 1, 2 and 5
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "result": ("o", {"markersize": 8, "zorder": 3}),
    "mean": ("-o", {"markersize": 4}),
    "seed": (".", {"alpha": 0.6}),
    "way": ("-", {"linewidth": 1, "alpha": 0.7}),
    "front": ("--", {"color": "black", "linewidth": 0.8, "zorder": 2}),
    "published": ("x", {"color": "0.55", "markersize": 5}),
    "paper": ("D", {"color": "#c2662d", "markersize": 5}),
    "undisturbed": ("-", {"color": "#2f8a4f", "linewidth": 0.8}),
    "still": (":", {"color": "0.45"}),
    "breaks": ("-", {"color": "#b3362f"}),
    "notice": ("--", {"color": "#c98a1b"}),
}
"""How matplotlib draws a kind of curve; a kind without a colour has that of its name."""
UPRIGHT = ("breaks", "notice")  # a line from bottom to top at the place of the only point
LABELS = {"way": "on the way there, a few views", "published": "published: other data, other device"}
"""Of kinds that stand in the legend once, whatever their names are."""


@dataclass(frozen=True)
class Curve:
    """Points of one name in a panel.

    Attributes:
        name: In the legend; the same name has the same colour in every panel.
        points: (x, y).
        kind: A key of `KINDS`.
    """

    name: str
    points: Sequence[tuple[float | int, float]]
    kind: str


@dataclass(frozen=True)
class Panel:
    """Curves on one pair of axes.

    Attributes:
        curves: What is drawn, in this order.
        x_label, y_label, title: Words beside it.
        ticks: Names of the places 0, 1, …; None: numbers.
        log: A logarithmic x axis.
        notes: Place -> words that stand upright at the foot there.
    """

    curves: Sequence[Curve]
    x_label: str = ""
    y_label: str = ""
    title: str = ""
    ticks: Sequence[str] | None = None
    log: bool = False
    notes: Mapping[int, str] = field(default_factory=dict)


def seed_curves(name: str, values: Mapping[int, Sequence[float | None]]) -> list[Curve]:
    """Means over seeds as a line and single seeds as dots; by place on the x axis."""
    found = {x: v for x, of in values.items() if (v := [one for one in of if one is not None])}
    means = [(x, fmean(v)) for x, v in found.items()]
    return [
        Curve(name, means, "mean"),
        Curve(name, [(x, one) for x, v in found.items() for one in v], "seed"),
    ]


def chart(
    path: Path,
    rows: Sequence[Sequence[Panel]],
    title: str,
    inches: tuple[float, float] | None = None,
    **shared: Any,
) -> Path:
    """Draw rows of panels.

    Args:
        path: The PNG.
        rows: Panels, the longest row first.
        title: Above all.
        inches: Size of a panel; None: by how many stand in a row.
        shared: Which axes have one scale: `sharex`, `sharey` of matplotlib's `subplots`.
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    across = len(rows[0]) if rows else 1
    width, height = inches or (PANEL_INCHES if across == 1 else SMALL_INCHES)
    size = (width * across, 0.8 + height * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title, fontsize=10)
    table = figure.subplots(max(1, len(rows)), across, squeeze=False, **shared)
    curves = [curve for row in rows for panel in row for curve in panel.curves]
    names = list(dict.fromkeys(c.name for c in curves if c.kind in ("result", "mean")))
    colours = {name: colormaps["tab10"](n % 10) for n, name in enumerate(names)}
    legend: dict[str, Any] = {}
    for n, line in enumerate(table):
        for m, axes in enumerate(line):
            if n >= len(rows) or m >= len(rows[n]):
                axes.set_axis_off()
                continue
            _draw(axes, rows[n][m], colours)
            legend |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    columns = min(5, len(legend))
    if legend:
        figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns, fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
    return path


def _draw(axes: Any, panel: Panel, colours: Mapping[str, Any]) -> None:
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    axes.set(xlabel=panel.x_label, ylabel=panel.y_label)
    axes.set_title(panel.title, fontsize=9)
    axes.grid(True, alpha=0.3)
    if panel.log:
        axes.set_xscale("log")
    for curve in panel.curves:
        style, look = KINDS[curve.kind]
        label = None if curve.kind == "seed" else LABELS.get(curve.kind, curve.name)
        look = {"color": colours.get(curve.name), "label": label} | look
        if curve.kind in UPRIGHT:
            axes.axvline(curve.points[0][0], linestyle=style, **look)
        elif curve.points:
            axes.plot(*zip(*curve.points, strict=True), style, **look)
        if curve.kind == "published":
            offset = {"xytext": (NAME_OFFSET, NAME_OFFSET), "textcoords": "offset points"}
            axes.annotate(curve.name, curve.points[0], fontsize=5.5, color="0.45", **offset)
    if panel.ticks is not None:
        axes.set_xticks(range(len(panel.ticks)), panel.ticks)
        axes.set_xlim(-0.4, len(panel.ticks) - 0.6)
    for place, words in panel.notes.items():
        foot = {"xycoords": ("data", "axes fraction"), "rotation": 90}
        axes.annotate(words, (place, 0.03), fontsize=7, color=KINDS["breaks"][1]["color"], **foot)
    if panel.log:
        low, high = axes.get_xlim()
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)) if high > WIDE * low else MaxNLocator(4))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter("{x:g}")
