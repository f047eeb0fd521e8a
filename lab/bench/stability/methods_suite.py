"""`bench stability --methods`: methods for moving scenes along axes of damage, where which of them fails."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError, InputError
from devrf.flow.store import read_flows
from devrf.lab.bench.bench_charts import Panel, chart, seed_curves
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.case import UNDISTURBED, Result, run_case
from devrf.lab.bench.stability.chart import COLUMNS, INCHES
from devrf.lab.bench.stability.damage.intact import DoesNotApply
from devrf.lab.bench.stability.points import points
from devrf.lab.bench.stability.suite import Extent
from devrf.lab.bench.training.methods import Contest, check, measured, method_task
from devrf.lab.bench.training.trainings import Bench, spread
from devrf.lab.methods.method_table import METHODS
from devrf.lab.methods.protocol import Method
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.pipelines.stages import STAGES
from devrf.reconstruct.evaluation.evaluate import motion_psnr

CALIBRATED = "flow"  # the last stage of the pipeline; what follows is each method's own


@dataclass
class Found:
    """What came of all cases.

    Attributes:
        undisturbed: By method, one for every seed.
        cases: By axis, then by method, every severity and seed.
        left_out: Axis -> why it, or the rest of it, was not tried.
    """

    undisturbed: dict[str, list[Result]] = field(default_factory=dict)
    cases: dict[str, dict[str, list[Result]]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)


def run_stability_of_methods(
    base: Run, out: Path, names: Sequence[str], extent: Extent, contest: Contest, json_path: Path
) -> list[Row]:
    """Damage the scene along axes, train each method on every case; print, draw and write what came of it.

    Args:
        base: The scene, with test cameras.
        out: Folder for the cases; one that was begun is gone on with.
        names: Axes.
        extent: How much of them.
        contest: Methods, and what they are given.
        json_path: Where the rows go; the chart is drawn beside it. Both are written anew after each axis.
    Raises:
        DevrfError: The undisturbed scene is not calibrated.
        InputError: A method cannot do what is asked for; nothing was trained.
    """
    methods = {name: METHODS[name].load() for name in contest.names}
    until = time.monotonic() + 60 * extent.minutes
    found, calm = Found(), dict[int, Bench]()
    for seed in contest.seeds:
        ready = _calibrated(base, out, UNDISTURBED, 0.0, seed)
        if isinstance(ready, Result):
            raise DevrfError("stage-failed", f"the undisturbed scene has no result: {ready.stopped}")
        calm[seed] = ready
        if not any(frame.split == "test" for frame in ready.scene.dynamic):
            text = f"{base.config.name}: bench stability needs a test camera of what moves (capture.test_cameras)"
            raise InputError("test-camera-missing", text)
        for name, method in methods.items():
            check(name, method, method_task(ready, contest, seed))
    for seed, ready in calm.items():
        for name, method in methods.items():
            result = _trained(ready, contest, name, method, Result(UNDISTURBED, 0.0, seed))
            found.undisturbed.setdefault(name, []).append(result)
    rows: list[Row] = []
    for axis in names:
        for severity in AXES[axis].some(extent.severities):
            if time.monotonic() >= until:
                late = f"from {severity:g} on nothing was begun after {extent.minutes:g} minutes"
                found.left_out.setdefault(axis, late)
                break
            try:
                for seed in contest.seeds:
                    ready = _calibrated(base, out, axis, severity, seed, calm[seed].scene)
                    for name, method in methods.items():
                        of_case = Result(axis, severity, seed, films_anew=AXES[axis].films_anew)
                        result = (
                            ready
                            if isinstance(ready, Result)
                            else _trained(ready, contest, name, method, of_case)
                        )
                        found.cases.setdefault(axis, {}).setdefault(name, []).append(result)
            except DoesNotApply as reason:
                found.left_out[axis] = f"does not apply: {reason}"
                break
        rows = _written(calm[contest.seeds[0]], contest, found, json_path, last=axis == names[-1])
    for axis, why in found.left_out.items():
        base.talk.say(f"{axis}: {why}")
    return rows


def _calibrated(
    base: Run, out: Path, axis: str, severity: float, seed: int, undisturbed: Scene | None = None
) -> Bench | Result:
    """A case up to its optical flow; the result, where it was stopped before."""
    only = replace(base, choice=Choice(last=CALIBRATED))
    result, run_dir = run_case(only, out, axis, severity, seed, undisturbed)
    if result.stopped is not None:
        return result
    config = base.config.model_copy(update={"output": str(run_dir)})
    run = Run(config, base.scene_dir, STAGES, Choice(), base.talk, base.device)
    return Bench(run, run_dir.parent / "methods", read_scene(run_dir / "scene"), read_flows(run_dir / "flow"))


def _trained(bench: Bench, contest: Contest, name: str, method: Method, case: Result) -> Result:
    """One method on a case, now or when it was before; what it cannot do is a result."""
    try:
        check(name, method, method_task(bench, contest, case.seed))
        found = measured(bench, contest, name, method, case.seed)
    except (DevrfError, MemoryError) as error:
        return Result(case.axis, case.severity, case.seed, str(error) or type(error).__name__)
    moving, baseline = motion_psnr(found.result)
    bench.run.talk.say(
        f"{case.axis} {case.severity:g}, seed {case.seed}, {name}: "
        + ("no pixel moves" if moving is None else f"{moving:.2f} dB")
    )
    return Result(
        case.axis,
        case.severity,
        case.seed,
        psnr=found.psnr,
        psnr_moving=moving,
        baseline=baseline,
        seconds=found.seconds,
        films_anew=case.films_anew,
    )


def _written(bench: Bench, contest: Contest, found: Found, path: Path, last: bool) -> list[Row]:
    """Rows and chart of what there is so far; printed at the end."""
    rows = [row for name, of in found.undisturbed.items() for row in _rows(f"{name}/undisturbed", of)]
    for axis, by_method in found.cases.items():
        for name, cases in by_method.items():
            for severity in sorted({r.severity for r in cases}):
                rows += _rows(f"{name}/{axis}/{severity:g}", [r for r in cases if r.severity == severity])
            failure = points(cases, found.undisturbed[name]).failure
            why = None if failure is not None else "it breaks at none of the severities"
            rows.append(Row(f"stability/{name}/{axis}/failure point", failure, AXES[axis].unit, why=why))
    panels = [_panel(axis, by_method, found.undisturbed) for axis, by_method in found.cases.items()]
    drawn = None
    if panels:
        grid = [panels[n : n + COLUMNS] for n in range(0, len(panels), COLUMNS)]
        drawn = chart(path.with_suffix(".png"), grid, "PSNR where it moves, dB", INCHES, sharey=True)
    about = {
        "regime": contest.regime,
        "size": contest.size,
        "seconds": contest.seconds,
        "left_out": found.left_out,
        "axes": {axis: {"what": AXES[axis].what, "unit": AXES[axis].unit} for axis in found.cases},
    }
    title = f"Stability of methods, {bench.run.config.name}" if last else None
    return bench.publish(
        title, rows, path, contest.seeds, drawn if last else None, benchmark="stability of methods", **about
    )


def _rows(name: str, cases: Sequence[Result]) -> list[Row]:
    """Mean and spread over seeds; what stopped those that have no result."""
    reached = [r.psnr_moving for r in cases if r.psnr_moving is not None]
    why = next((r.stopped for r in cases if r.stopped is not None), None if reached else "no pixel moves")
    value = fmean(reached) if reached else None
    return [Row(f"stability/{name}/psnr_moving", value, "dB", spread(reached), why=why)]


def _panel(
    axis: str, by_method: Mapping[str, Sequence[Result]], undisturbed: Mapping[str, Sequence[Result]]
) -> Panel:
    """One axis: a curve a method, the undisturbed case first."""
    places = sorted({r.severity for cases in by_method.values() for r in cases})
    curves = []
    for name, cases in by_method.items():
        columns = [undisturbed[name], *([r for r in cases if r.severity == place] for place in places)]
        curves += seed_curves(name, {n: [r.psnr_moving for r in of] for n, of in enumerate(columns)})
    return Panel(curves, AXES[axis].unit, title=axis, ticks=["none", *(f"{place:g}" for place in places)])
