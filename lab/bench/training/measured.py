"""What trainings came to, on the axes of a chart of accuracy against cost."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from devrf.lab.bench.bench_charts import Curve, Panel
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.published import PUBLISHED
from devrf.lab.bench.training.trainings import score_rows

AXES = {"seconds": "seconds of training", "megabytes": "megabytes", "fps": "pictures per second"}
METRICS = {"psnr": "PSNR of test views, dB", "lpips_vgg": "LPIPS (VGG) of test views"}
BETTER_LOW = ("seconds", "megabytes")


@dataclass(frozen=True)
class Measured:
    """What one way to train came to.

    Attributes:
        name: Of the way.
        result: `evaluate`'s blocks, `model_mb`, `render_fps`.
        looks: At a few test views on the way there: `seconds` and `psnr`.
        seconds: Of training.
    """

    name: str
    result: dict[str, Any]
    looks: list[dict[str, float]]
    seconds: float

    @property
    def psnr(self) -> float:
        """Of all test views, at the end, dB."""
        return self.result["test"]["psnr"]

    def on(self, axis: str) -> float:
        """Its place on an axis of the chart."""
        at = {"seconds": self.seconds, "megabytes": self.result["model_mb"], "fps": self.result["render_fps"]}
        return at[axis]

    def rows(self, benchmark: str) -> list[Row]:
        """Scores and costs."""
        name = f"{benchmark}/{self.name}"
        return [
            *score_rows(name, [self.result])[:-1],  # without the seconds of the motion alone
            Row(f"{name}/seconds", self.seconds, "s"),
            Row(f"{name}/megabytes", self.result["model_mb"], "MB"),
            Row(f"{name}/render_fps", self.result["render_fps"], "pictures/s"),
        ]


def pareto(found: Sequence[Measured], axis: str) -> list[Measured]:
    """Those that no other beats in PSNR without being worse on the axis, from best to worst PSNR."""
    sign = 1.0 if axis in BETTER_LOW else -1.0
    best: list[Measured] = []
    for one in sorted(found, key=lambda one: (sign * one.on(axis), -one.psnr)):
        if not best or one.psnr > best[-1].psnr:
            best.append(one)
    return best[::-1]


def panels(found: Sequence[Measured], published: bool = True) -> list[list[Panel]]:
    """A row of panels for each metric that all have; with the figures of others, where asked for."""
    return [
        [
            Panel(_curves(metric, axis, found, published), x_label, y_label, log=True)
            for axis, x_label in AXES.items()
        ]
        for metric, y_label in METRICS.items()
        if all(one.result["test"][metric] is not None for one in found)
    ]


def _curves(metric: str, axis: str, found: Sequence[Measured], published: bool) -> list[Curve]:
    """Trainings on an axis; with PSNR also how they got there, those not beaten as a line, and published ones."""
    curves = [Curve(one.name, [(one.on(axis), one.result["test"][metric])], "result") for one in found]
    if metric != "psnr":
        return curves
    if axis == "seconds":
        for one in found:
            way = [(look["seconds"], look["psnr"]) for look in one.looks if look["seconds"] > 0]
            curves.append(Curve(one.name, way, "way"))
    curves.append(Curve("not beaten", [(one.on(axis), one.psnr) for one in pareto(found, axis)], "front"))
    others = [(row.name, getattr(row, axis), row.psnr) for row in PUBLISHED] if published else []
    return curves + [Curve(name, [(at, psnr)], "published") for name, at, psnr in others if at is not None]
