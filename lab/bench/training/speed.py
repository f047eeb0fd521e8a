"""`bench speed`: accuracy against seconds of training, megabytes and pictures per second, of several presets."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from devrf.lab.bench.bench_charts import chart
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.measured import AXES, Measured, panels, pareto
from devrf.lab.bench.training.progress_views import Looks
from devrf.lab.bench.training.published import PUBLISHED
from devrf.lab.bench.training.trainings import Bench, device_name
from devrf.pipelines.config.scene import ReconstructConfig
from devrf.reconstruct.options import TrainingOptions
from devrf.reconstruct.training.loop import TrainingRun
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

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
    rows = [row for one in found for row in one.rows("speed")] + _against_reference(bench, found)
    front = {axis: [one.name for one in pareto(found, axis)] for axis in AXES}
    for axis, names in front.items():
        bench.run.talk.say(f"not beaten by {axis} ({AXES[axis]}): {', '.join(names)}")
    title = f"{bench.run.config.name}, {device_name(bench.run.device)}"
    drawn = chart(json_path.with_suffix(".png"), panels(found), title, sharey="row", sharex="col")
    about = {
        "front": front,
        "set": {name: chosen.model_dump(exclude_none=True) for name, chosen in presets.items()},
        "curves": {one.name: one.looks for one in found},
        "published": [vars(row) for row in PUBLISHED],
    }
    title, seeds = f"Speed and accuracy, {bench.run.config.name}", [bench.run.config.reconstruct.seed]
    return bench.publish(title, rows, json_path, seeds, drawn, benchmark="speed", **about)


def options_of(bench: Bench, case: Case) -> TrainingOptions:
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
    return Measured(case.name, result, [*rest.metrics.get("looks", []), *later], seconds)


def _against_reference(bench: Bench, found: Sequence[Measured]) -> list[Row]:
    """Every case beside `reference`; the goals are for `fast` in full."""
    by_name = {one.name: one for one in found}
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
