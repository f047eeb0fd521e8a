"""Charts of benchmarks as PNG files: bars and lines over seeds, each seed a dot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIZE_INCHES, DPI = (7.0, 4.2), 130


def bars(
    path: Path, values: Mapping[str, Sequence[float]], anchors: Mapping[str, float], y_label: str, title: str
) -> Path:
    """Means as bars, seeds as dots, what others report as a dashed line."""
    figure, axes = _figure(y_label, title)
    x = np.arange(len(values))
    axes.bar(x, [np.mean(v) for v in values.values()], color="#7aa6d6", width=0.6, label="ours")
    for n, v in enumerate(values.values()):
        axes.plot([n] * len(v), v, ".", color="#1f3d66")
    axes.plot(x, [anchors[name] for name in values], "--o", color="#c2662d", label="the paper (other data)")
    axes.set_xticks(x, list(values))
    lowest = min(min(min(v) for v in values.values()), min(anchors.values()))
    axes.set_ylim(bottom=max(0.0, np.floor(lowest - 3)))
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
