"""Charts of benchmarks as PNG files: cases and lines over seeds, each seed a dot."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

SIZE_INCHES, DPI = (7.0, 4.2), 130


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
