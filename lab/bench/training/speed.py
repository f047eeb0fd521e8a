"""`bench speed`: accuracy against seconds of training, megabytes and pictures per second, of several presets."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from devrf.lab.bench.bench_charts import Curve, Panel, chart
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.progress_views import Looks
from devrf.lab.bench.training.published import PUBLISHED
from devrf.lab.bench.training.trainings import Bench, device_name, score_rows
from devrf.pipelines.config.scene import ReconstructConfig
from devrf.reconstruct.options import Options
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

AXES = {"seconds": "seconds of training", "megabytes": "megabytes", "fps": "pictures per second"}
METRICS = {"psnr": "PSNR of test views, dB", "lpips_vgg": "LPIPS (VGG) of test views"}
BETTER_LOW = ("seconds", "megabytes")
GOAL_SHARE = {"cpu": 1 / 8, "cuda": 1 / 15}  # of `reference`'s time, that `fast` may take
GOAL_LOSS_DB = -0.1
GOAL_RENDERING = 20.0  # times as many pictures a second as `reference`
REFERENCE, FAST = "reference", "fast"


@dataclass(frozen=True)
class Case:
    """One way to train: a preset, with all of its iterations or a share of them, and what is set for it."""

    preset: str
    effort: float
    chosen: ReconstructConfig

    @property
    def name(self) -> str:
        """`fast`, or `fast x0.25`."""
        return self.preset if self.effort == 1.0 else f"{self.preset} x{self.effort:g}"


@dataclass(frozen=True)
class Measured:
    """What one way came to; `looks` are at a few test views, on the way there."""

    case: Case
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


def run_speed(
    bench: Bench,
    presets: dict[str, ReconstructConfig],
    efforts: Sequence[float],
    every_s: float,
    json_path: Path,
) -> list[Row]:
    """Train each preset with each share of its iterations; print, draw and write what came of it.

    Args:
        bench: The scene; all presets train on the same pictures, at its size.
        presets: What scene.yaml and the command line say about training, by name of preset.
        efforts: Shares of a preset's iterations; each is a training of its own, with its own schedule.
        every_s: Seconds of training to the second look at the test views, which is off the clock.
        json_path: Where the rows go; the chart is drawn beside it.
    """
    _load_kernels(bench)
    found = [
        _measure(bench, Case(preset, effort, chosen), every_s)
        for preset, chosen in presets.items()
        for effort in sorted(efforts)
    ]
    rows = [row for one in found for row in _rows(one)] + _against_reference(bench, found)
    front = {axis: [one.case.name for one in pareto(found, axis)] for axis in AXES}
    for axis, names in front.items():
        bench.run.talk.say(f"not beaten by {axis} ({AXES[axis]}): {', '.join(names)}")
    panels = [
        [Panel(_curves(metric, axis, found), x_label, y_label, log=True) for axis, x_label in AXES.items()]
        for metric, y_label in METRICS.items()
        if all(one.result["test"][metric] is not None for one in found)
    ]
    title = f"{bench.run.config.name}, {device_name(bench.run.device)}"
    drawn = chart(json_path.with_suffix(".png"), panels, title, sharey="row", sharex="col")
    about = {
        "front": front,
        "set": {name: chosen.model_dump(exclude_none=True) for name, chosen in presets.items()},
        "curves": {one.case.name: one.looks for one in found},
        "published": [vars(row) for row in PUBLISHED],
    }
    title, seeds = f"Speed and accuracy, {bench.run.config.name}", [bench.run.config.reconstruct.seed]
    return bench.publish(title, rows, json_path, seeds, drawn, benchmark="speed", **about)


def pareto(found: Sequence[Measured], axis: str) -> list[Measured]:
    """Those that no other beats in PSNR without being worse on the axis, from best to worst PSNR."""
    sign = 1.0 if axis in BETTER_LOW else -1.0
    best: list[Measured] = []
    for one in sorted(found, key=lambda one: (sign * one.on(axis), -one.psnr)):
        if not best or one.psnr > best[-1].psnr:
            best.append(one)
    return best[::-1]


def options_of(bench: Bench, case: Case) -> Options:
    """The case's options: what scene.yaml overrides counts for every preset, then the share of the iterations."""
    chosen = dict(case.chosen)
    options = bench.options(case.preset, **chosen)
    if case.effort == 1.0:
        return options
    shares = {
        "canonical_iterations": max(1, round(case.effort * options.canonical.iterations)),
        "motion_iterations": max(1, round(case.effort * sum(options.motion.iterations))),
    }
    return bench.options(case.preset, **(chosen | shares))


def _load_kernels(bench: Bench) -> None:
    """Train for an instant, so that the first case does not pay for what is compiled at first use."""
    options, run = bench.options("tiny", canonical_iterations=1), TrainingRun(bench.run.device)
    canonical = replace(options.canonical, resolution=16, shell_resolution=16, coarse_size=16, scale_at=())
    rest = train_canonical(bench.scene, canonical, run)
    motion = replace(options.motion, levels=(4,), iterations=(1,))
    train_motion(bench.scene, rest, bench.flows, motion, run)


def _measure(bench: Bench, case: Case, every_s: float) -> Measured:
    one = replace(bench, out=bench.out / case.name.replace(" ", "-"))
    options = options_of(bench, case)
    looks = Looks(bench.scene, every_s)
    rest = one.rest(options.canonical, looks)
    result = one.motion("motion", rest, options.motion, looks=looks)
    before = rest.metrics["seconds"]
    later = [look | {"seconds": round(before + look["seconds"], 2)} for look in result.get("looks", [])]
    seconds = before + result["train"]["seconds"]
    return Measured(case, result, [*rest.metrics.get("looks", []), *later], seconds)


def _rows(one: Measured) -> list[Row]:
    name = f"speed/{one.case.name}"
    return [
        *score_rows(name, [one.result])[:-1],  # without the seconds of the motion alone
        Row(f"{name}/seconds", one.seconds, "s"),
        Row(f"{name}/megabytes", one.result["model_mb"], "MB"),
        Row(f"{name}/render_fps", one.result["render_fps"], "pictures/s"),
    ]


def _against_reference(bench: Bench, found: Sequence[Measured]) -> list[Row]:
    """Every case beside `reference`; the goals are for `fast` in full."""
    by_name = {one.case.name: one for one in found}
    reference = by_name.get(REFERENCE)
    if reference is None:
        return []
    rows = []
    for name, one in by_name.items():
        if one is reference:
            continue
        goals = (GOAL_SHARE[bench.run.device], GOAL_LOSS_DB, GOAL_RENDERING) if name == FAST else [None] * 3
        share, faster = one.seconds / reference.seconds, one.on("fps") / reference.on("fps")
        rows += [
            Row(f"speed/{name} of reference/seconds", share, "").at_most(goals[0]),
            Row(f"speed/{name} over reference/psnr", one.psnr - reference.psnr, "dB").at_least(goals[1]),
            Row(f"speed/{name} of reference/render_fps", faster, "").at_least(goals[2]),
        ]
    return rows


def _curves(metric: str, axis: str, found: Sequence[Measured]) -> list[Curve]:
    """Our cases on an axis; with PSNR also how they got there, those not beaten as a line, and published ones."""
    curves = [Curve(one.case.name, [(one.on(axis), one.result["test"][metric])], "result") for one in found]
    if metric != "psnr":
        return curves
    if axis == "seconds":
        for one in found:
            way = [(look["seconds"], look["psnr"]) for look in one.looks if look["seconds"] > 0]
            curves.append(Curve(one.case.name, way, "way"))
    front = [(one.on(axis), one.psnr) for one in pareto(found, axis)]
    others = [(row.name, getattr(row, axis), row.psnr) for row in PUBLISHED]
    published = [Curve(name, [(at, psnr)], "published") for name, at, psnr in others if at is not None]
    return [*curves, Curve("not beaten", front, "front"), *published]
