"""`bench stability`: a scene along axes of damage, through the real pipeline; where it breaks, and what it says."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean

from devrf.capture.formats.parts.scene_files import read_scene
from devrf.capture.system.errors import DevrfError, InputError
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.stability.axes import AXES
from devrf.lab.bench.stability.case import UNDISTURBED, Result, is_made, run_case
from devrf.lab.bench.stability.chart import axes_chart
from devrf.lab.bench.stability.damage.intact import DoesNotApply
from devrf.lab.bench.stability.points import LEAST_GAIN_DB, Points, bar_db, points
from devrf.lab.bench.stability.precision_recall import SUFFERED_DB, PrecisionRecall, heard
from devrf.lab.bench.training.trainings import Bench, spread
from devrf.pipelines.runner.run_state import Run
from devrf.pipelines.terminal.console import Talk, duration

MEASURES = {
    "psnr_moving": "dB",
    "psnr": "dB",
    "lpips": "",
    "rotation_deg": "°",
    "position_m": "m",
    "sync_ms": "ms",
    "seconds": "s",
}
HEARD_GOAL = 0.9  # of recall, and of precision


@dataclass(frozen=True)
class Extent:
    """How much is tried.

    Attributes:
        severities: How many of each axis, the worst among them; None: all.
        seeds: Of the trainings and of what is drawn at random.
        minutes: No case begins later; what there is by then, of earlier runs too, is written.
    """

    severities: int | None
    seeds: Sequence[int]
    minutes: float = math.inf


def run_stability(
    base: Run,
    out: Path,
    names: Sequence[str],
    extent: Extent,
    json_path: Path,
) -> list[Row]:
    """Damage the scene along axes; print, draw and write what came of it.

    Args:
        base: The scene, with test cameras.
        out: Folder for the cases; one that was begun is gone on with.
        names: Axes.
        extent: How much of them.
        json_path: Where the rows go; the chart is drawn beside it.
    Raises:
        DevrfError: The undisturbed scene has no result.
        InputError: It has no test camera that sees something move.
    """
    talk, capture, until = base.talk, base.config.capture, time.monotonic() + 60 * extent.minutes
    seeds = extent.seeds
    needs = "bench stability needs a test camera of what moves (capture.test_cameras, or the data set's test split)"
    if capture is not None and not capture.test_names:
        raise InputError("test-camera-missing", f"{base.config.name}: no test camera is named; {needs}")
    undisturbed, scenes = [], {}
    for seed in seeds:
        result, run_dir = run_case(base, out, UNDISTURBED, 0.0, seed)
        _tell(talk, result)
        if result.stopped is not None:
            raise DevrfError("stage-failed", f"the undisturbed scene has no result: {result.stopped}")
        if result.psnr_moving is None:
            text = f"{base.config.name}: nothing moves in its test views; {needs}"
            raise InputError("scene-without-motion", text)
        scenes[seed] = read_scene(run_dir / "scene")
        undisturbed.append(result)
    bar = bar_db(undisturbed)
    if bar is None:
        talk.say(
            f"the undisturbed result gains less than {LEAST_GAIN_DB:g} dB over the scene at rest: "
            "only what stops the pipeline counts as a failure"
        )
    results: dict[str, list[Result]] = {}

    def tried(name: str, severity: float, seed: int) -> None:
        result, _ = run_case(base, out, name, severity, seed, scenes[seed])
        _tell(talk, result)
        results.setdefault(name, []).append(result)

    left_out = each_case(names, extent, until, lambda *case: is_made(out, *case), tried)
    found = {name: points(cases, undisturbed) for name, cases in results.items()}
    rows = _rows(UNDISTURBED, undisturbed)
    for name, cases in results.items():
        for severity in sorted({r.severity for r in cases}):
            rows += _rows(f"{name}/{severity:g}", [r for r in cases if r.severity == severity])
        rows += _points_rows(name, found[name])
    known = heard(results, undisturbed, found)
    rows += _heard_rows(known)
    for name, why in left_out.items():
        talk.say(f"{name}: {why}")
    json_path.parent.mkdir(parents=True, exist_ok=True)
    chart = axes_chart(json_path.with_suffix(".png"), results, undisturbed, found)
    shares = {name: getattr(known, name) for name in ("recall", "precision", "precision_or_early")}
    more = {
        "bar_db": bar,
        "left_out": left_out,
        "axes": {name: {"what": a.what, "unit": a.unit} for name, a in AXES.items() if name in results},
        "points": {name: asdict(p) for name, p in found.items()},
        "heard": asdict(known) | shares,
        "cases": [asdict(r) for r in (*undisturbed, *(r for cases in results.values() for r in cases))],
    }
    title, bench = f"Stability, {base.config.name}", Bench(base, out, scenes[seeds[0]], {})
    return bench.publish(title, rows, json_path, seeds, chart, benchmark="stability", **more)


def each_case(
    names: Sequence[str],
    extent: Extent,
    until: float,
    made: Callable[[str, float, int], bool],
    tried: Callable[[str, float, int], None],
) -> dict[str, str]:
    """Try all cases: axis, severity, seed.

    Args:
        until: From this moment of the monotonic clock on only those that are made.
    Returns:
        Axis -> why it, or the rest of it, was not tried.
    """
    left_out: dict[str, str] = {}
    for name in names:
        for severity in AXES[name].some(extent.severities):
            for seed in extent.seeds:
                if time.monotonic() >= until and not made(name, severity, seed):
                    late = f"from {severity:g} on nothing was begun after {extent.minutes:g} minutes"
                    left_out.setdefault(name, late)
                    continue
                try:
                    tried(name, severity, seed)
                except DoesNotApply as reason:  # of its worst severity, if only from there on
                    left_out[name] = f"does not apply: {reason}"
                    break
    return left_out


def _tell(talk: Talk, result: Result) -> None:
    what = f"{result.axis} {result.severity:g}, seed {result.seed}"
    if result.stopped is not None:
        talk.say(f"{what}: stopped by {result.stopped.splitlines()[0]}")
    else:
        moving = "no pixel moves" if result.psnr_moving is None else f"{result.psnr_moving:.2f} dB"
        talk.say(f"{what}: {moving}, stages of {duration(result.seconds)}")


def _rows(name: str, cases: Sequence[Result]) -> list[Row]:
    """Means and spreads over seeds; how many were stopped."""
    stopped = [r.stopped for r in cases if r.stopped is not None]
    why = stopped[0] if stopped else None
    rows = [Row(f"stability/{name}/stopped", float(len(stopped)), "seeds", why=why)]
    for measure, unit in MEASURES.items():
        values = [v for r in cases if (v := getattr(r, measure)) is not None]
        if values:
            rows.append(Row(f"stability/{name}/{measure}", fmean(values), unit, spread(values)))
    return rows


def _points_rows(name: str, found: Points) -> list[Row]:
    unit = AXES[name].unit
    rows = [] if found.lessened is None else [Row(f"stability/{name}/one step less", found.lessened_db, "dB")]
    return [
        *rows,
        Row(f"stability/{name}/failure point", found.failure, unit, why=_never(found.failure, "breaks")),
        Row(f"stability/{name}/notice point", found.notice, unit, why=_never(found.notice, "is noticed")),
    ]


def _heard_rows(known: PrecisionRecall) -> list[Row]:
    """Recall, precision and false alarms, and what keeps them from being perfect."""
    missed = f"nothing is said in time of {', '.join(known.missed)}" if known.missed else None
    lost = f"less than {SUFFERED_DB:g} dB lost: {'; '.join(known.unfounded)}" if known.unfounded else None
    early = f"before the axis breaks: {'; '.join(known.early)}" if known.early else None
    said_anyway = f"said of the undisturbed scene: {'; '.join(known.alarms)}" if known.alarms else None
    recall = Row("stability/recall", known.recall, "", why=missed if known.broken else "nothing breaks")
    why = lost if known.spoken else "nothing is said"
    precision = Row("stability/precision", known.precision, "", why=why)
    return [
        recall.at_least(HEARD_GOAL),
        precision.at_least(HEARD_GOAL),
        Row("stability/precision, early or hurt", known.precision_or_early, "", why=early),
        Row("stability/undisturbed/complaints", float(len(known.alarms)), "", why=said_anyway),
    ]


def _never(severity: float | None, what: str) -> str | None:
    return None if severity is not None else f"it {what} at none of the severities"
