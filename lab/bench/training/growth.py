"""`bench growth`: how seconds and bytes grow with the number of pictures, the resolution and what moves."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from devrf.capture.errors import InputError
from devrf.lab.bench.bench_charts import Curve, frontier_chart
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.trainings import Bench, device_name
from devrf.pipelines.runner.run import Run
from devrf.reconstruct.options import PRESETS

AXES = {
    "pictures": "pictures per camera",
    "resolution": "resolution R at rest",
    "moving": "voxels in which something moves",
}
UNITS = {"seconds": "s", "megabytes": "MB", "psnr": "dB", "keys": ""}
COSTS = {"seconds": "seconds of training", "megabytes": "megabytes on disk"}


@dataclass(frozen=True)
class Grown:
    """One training: along which axis, which on it, where, and what it came to by the names of `UNITS`."""

    axis: str
    name: str
    at: float
    came_to: dict[str, float]


def run_growth(
    run: Run,
    out: Path,
    strides: Sequence[int],
    shares: Sequence[float],
    others: Sequence[Run],
    json_path: Path,
) -> list[Row]:
    """Train with every so many pictures, at shares of the resolution, and other scenes; say what it cost.

    Args:
        run: The scene: a data set, whose times can be left out.
        out: Folder for models.
        strides: Every n-th time of those that the configuration takes.
        shares: Of the preset's resolution (or the one that is given).
        others: Scenes in which more or less moves.
        json_path: Where the rows go; the chart is drawn beside it.
    """
    if run.config.dataset is None:
        text = "bench growth leaves out times of a data set; export the capture as one first"
        raise InputError("scene-no-dataset", text)
    found = [_trained(_every(run, out, n), None, "pictures") for n in sorted(strides, reverse=True)]
    bench = _every(run, out, 1)
    whole = run.config.reconstruct.resolution or PRESETS[run.config.preset].canonical.resolution
    found += [_trained(bench, round(share * whole), "resolution") for share in sorted(shares)]
    if others:
        benches = [bench, *(Bench.prepare(other, out / f"other{n}") for n, other in enumerate(others, 1))]
        found += sorted((_trained(b, None, "moving") for b in benches), key=lambda one: one.at)
    axes = {axis: label for axis, label in AXES.items() if others or axis != "moving"}
    rows = []
    for one in found:
        name = f"growth/{one.axis}/{one.name}"
        rows += [Row(f"{name}/voxels", one.at, "")] if one.axis == "moving" else []
        rows += [Row(f"{name}/{what}", one.came_to[what], unit) for what, unit in UNITS.items()]
    rows += [_exponent(found, axis, cost) for axis in axes for cost in COSTS]
    named = {f"other{n}": other.scene_dir.name for n, other in enumerate(others, 1)}
    panels = {
        label: {text: _curves(found, axis, cost) for axis, text in axes.items()}
        for cost, label in COSTS.items()
    }
    title = f"{run.config.name}, {run.config.preset}, {device_name(run.device)}"
    chart = frontier_chart(json_path.with_suffix(".png"), panels, title)
    title, seeds = f"Growth, {run.config.name}", [run.config.reconstruct.seed]
    return bench.publish(title, rows, json_path, seeds, chart, benchmark="growth", others=named)


def _every(run: Run, out: Path, stride: int) -> Bench:
    """The scene with every n-th of its times."""
    dataset = run.config.dataset
    assert dataset is not None  # checked by the caller
    fewer = dataset.model_copy(update={"frame_stride": stride * dataset.frame_stride})
    less = replace(run, config=run.config.model_copy(update={"dataset": fewer}))
    return Bench.prepare(less, out / f"every{stride}")


def _trained(bench: Bench, resolution: int | None, axis: str) -> Grown:
    options = bench.options() if resolution is None else bench.options(resolution=resolution)
    if options != bench.options():  # else it has been trained along the other axis
        bench = replace(bench, out=bench.out / f"R{resolution}")
    rest = bench.rest(options.canonical)
    result = bench.motion("motion", rest, options.motion)
    clips = [f.camera_name for f in bench.scene.dynamic if f.split == "train"]
    at = {
        "pictures": max(clips.count(name) for name in set(clips)),
        "resolution": options.canonical.resolution,
        "moving": result["moving_voxels"],
    }
    came_to = {
        "seconds": rest.metrics["seconds"] + result["train"]["seconds"],
        "megabytes": result["model_mb"],
        "psnr": result["test"]["psnr"],
        "keys": float(result["train"]["keys"]),
    }
    return Grown(axis, bench.out.name if axis == "moving" else f"{at[axis]:g}", float(at[axis]), came_to)


def _points(found: Sequence[Grown], axis: str, cost: str) -> list[tuple[float, float]]:
    return [(one.at, one.came_to[cost]) for one in found if one.axis == axis]


def _exponent(found: Sequence[Grown], axis: str, cost: str) -> Row:
    """By which power of the axis a cost grows: the slope of a straight line through the logarithms."""
    points = [(at, value) for at, value in _points(found, axis, cost) if at > 0]
    name = f"growth/{axis}/exponent of {cost}"
    if len({at for at, _ in points}) < 2:
        return Row(name, None, "", why="needs two different places on the axis")
    x, y = np.log(np.array(points)).T
    return Row(name, float(np.polyfit(x, y, 1)[0]), "")


def _curves(found: Sequence[Grown], axis: str, cost: str) -> list[Curve]:
    points = _points(found, axis, cost)
    return [Curve("measured", points, "ours"), Curve("joined", points, "front")]
