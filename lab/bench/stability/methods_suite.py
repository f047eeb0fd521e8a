"""`bench stability --methods`: methods for moving scenes along axes of damage, where which of them fails."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError
from devrf.lab.bench.bench_charts import Panel, chart, seed_curves
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.case import UNDISTURBED, Result, case_folder, run_case
from devrf.lab.bench.stability.chart import COLUMNS, INCHES
from devrf.lab.bench.stability.points import points
from devrf.lab.bench.stability.suite import Extent, each_case
from devrf.lab.bench.training.methods import Contest, check, measured, method_task
from devrf.lab.bench.training.trainings import Bench, spread
from devrf.lab.methods.method_table import METHODS
from devrf.lab.methods.protocol import Method
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.runner.standing import Choice
from devrf.reconstruct.evaluation.evaluate import motion_psnr

CALIBRATED = "flow"  # the last stage of the pipeline; what follows is each method's own, ...
TRAINED = "methods"  # ... in this folder of a case


def run_stability_of_methods(
    base: Run, out: Path, names: Sequence[str], extent: Extent, contest: Contest, json_path: Path
) -> list[Row]:
    """Damage the scene along axes and train each method on every case; arguments and errors as `run_stability`'s.

    Raises:
        InputError: A method cannot do what is asked for; nothing was trained.
    """
    methods = {name: METHODS[name].load() for name in contest.names}
    until, calm = time.monotonic() + 60 * extent.minutes, dict[int, Bench]()
    for seed in extent.seeds:
        ready = _calibrated(base, out, UNDISTURBED, 0.0, seed)
        if isinstance(ready, Result):
            raise DevrfError("stage-failed", f"the undisturbed scene has no result: {ready.stopped}")
        calm[seed] = ready
        for name, method in methods.items():
            check(name, method, method_task(ready, contest, seed))
    undisturbed = {
        name: [_trained(calm[n], contest, name, method, Result(UNDISTURBED, 0.0, n)) for n in extent.seeds]
        for name, method in methods.items()
    }
    cases: dict[str, dict[str, list[Result]]] = {}  # by axis, then by method

    def tried(axis: str, severity: float, seed: int) -> None:
        ready = _calibrated(base, out, axis, severity, seed, calm[seed].scene)
        case = Result(axis, severity, seed, films_anew=AXES[axis].films_anew)
        for name, method in methods.items():
            result = ready if isinstance(ready, Result) else _trained(ready, contest, name, method, case)
            cases.setdefault(axis, {}).setdefault(name, []).append(result)

    def made(axis: str, severity: float, seed: int) -> bool:
        done = case_folder(out, axis, severity, seed) / TRAINED / f"seed{seed}"
        return all((done / contest.folder(name) / "metrics.json").is_file() for name in methods)

    left_out = each_case(names, extent, until, made, tried)
    for axis, why in left_out.items():
        base.talk.say(f"{axis}: {why}")
    rows = [row for name, of in undisturbed.items() for row in _rows(f"{name}/undisturbed", of)]
    for axis, by_method in cases.items():
        for name, of in by_method.items():
            for severity in sorted({r.severity for r in of}):
                rows += _rows(f"{name}/{axis}/{severity:g}", [r for r in of if r.severity == severity])
            failure = points(of, undisturbed[name]).failure
            why = None if failure is not None else "it breaks at none of the severities"
            rows.append(Row(f"stability/{name}/{axis}/failure point", failure, AXES[axis].unit, why=why))
    drawn = None
    if panels := [_panel(axis, by_method, undisturbed) for axis, by_method in cases.items()]:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        grid = [panels[n : n + COLUMNS] for n in range(0, len(panels), COLUMNS)]
        drawn = chart(json_path.with_suffix(".png"), grid, "PSNR where it moves, dB", INCHES, sharey=True)
    about = {
        "regime": contest.regime,
        "size": contest.size,
        "seconds": contest.seconds,
        "left_out": left_out,
        "axes": {axis: {"what": AXES[axis].what, "unit": AXES[axis].unit} for axis in cases},
    }
    title, bench = f"Stability of methods, {base.config.name}", calm[extent.seeds[0]]
    return bench.publish(
        title, rows, json_path, extent.seeds, drawn, benchmark="stability of methods", **about
    )


def _calibrated(
    base: Run, out: Path, axis: str, severity: float, seed: int, undisturbed: Scene | None = None
) -> Bench | Result:
    """A case up to its optical flow; the result, where it was stopped before."""
    only = replace(base, choice=Choice(last=CALIBRATED))
    result, run_dir = run_case(only, out, axis, severity, seed, undisturbed)
    if result.stopped is not None:
        return result
    run = replace(base, config=base.config.model_copy(update={"output": str(run_dir)}))
    return Bench.of_run(run, run_dir.parent / TRAINED)


def _trained(bench: Bench, contest: Contest, name: str, method: Method, case: Result) -> Result:
    """One method on a case, now or when it was before; what it cannot do is a result."""
    try:
        check(name, method, method_task(bench, contest, case.seed))
        found = measured(bench, contest, name, method, case.seed)
    except (DevrfError, MemoryError) as error:
        return replace(case, stopped=str(error) or type(error).__name__)
    moving, baseline = motion_psnr(found.result)
    reached = "no pixel moves" if moving is None else f"{moving:.2f} dB"
    bench.run.talk.say(f"{case.axis} {case.severity:g}, seed {case.seed}, {name}: {reached}")
    return replace(case, psnr=found.psnr, psnr_moving=moving, baseline=baseline, seconds=found.seconds)


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
