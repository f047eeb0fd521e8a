"""The measures of several runs, and which of their differences are more than chance."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from devrf.pipelines.compare.runs import SEED, ComparedRun, ViewKey
from devrf.pipelines.compare.same_views import common_views
from devrf.pipelines.report.run import at
from devrf.reconstruct.paired import Gain, paired_gain
from devrf.reconstruct.paired_views import gain_over_time


@dataclass(frozen=True)
class Measure:
    """One measure of evaluate/metrics.json.

    Attributes:
        key: Dotted, of its mean over the views.
        name: For people.
        unit, digits: How it is shown.
        in_view: Dotted, in a row of `per_view`; None where it is not measured view by view.
        of_moving: Over the test views of the moving scene, else over held-out pictures of the scene at rest.
        low_is_good: Whether less is better.
    """

    key: str
    name: str
    unit: str
    digits: int
    in_view: str | None = None
    of_moving: bool = True
    low_is_good: bool = False


MEASURES = (
    Measure("test_moving.psnr", "PSNR where it moves", "dB", 2, "moving.psnr"),
    Measure("test_moving.ssim", "SSIM where it moves", "", 4, "moving.ssim"),
    Measure("test.psnr", "PSNR, test views", "dB", 2, "psnr"),
    Measure("test.ssim", "SSIM, test views", "", 4, "ssim"),
    Measure("test.lpips_vgg", "LPIPS (VGG), test views", "", 4, "lpips_vgg", low_is_good=True),
    Measure("test.lpips_alex", "LPIPS (Alex), test views", "", 4, "lpips_alex", low_is_good=True),
    Measure("test_static.psnr", "PSNR, held-out sweep", "dB", 2, "psnr", of_moving=False),
    Measure("test_static.ssim", "SSIM, held-out sweep", "", 4, "ssim", of_moving=False),
    Measure("train.total_s", "training", "s", 0, low_is_good=True),
    Measure("train.peak_rss_gb", "peak main memory, training", "GB", 2, low_is_good=True),
    Measure("train.peak_gpu_gb", "peak GPU memory, training", "GB", 2, low_is_good=True),
    Measure("model_mb", "model", "MB", 1, low_is_good=True),
    Measure("render_fps", "pictures per second", "fps", 2),
)


@dataclass(frozen=True)
class Difference:
    """A run against the first one.

    Attributes:
        measure: What was measured.
        run: Name of the run.
        views: Views that both have; 0 where the measure is not taken view by view.
        gain: The mean difference and its interval; of what is no mean over views only the difference.
        verdict: better, worse, or `open`: the interval holds 0; `same`: not a single view differs; None: there is no
            interval.
    """

    measure: Measure
    run: str
    views: int
    gain: Gain
    verdict: str | None


@dataclass(frozen=True)
class SeedDifference:
    """Two groups of repeated runs, paired by seed.

    Attributes:
        measure: What was measured.
        groups: The names of the runs of both groups, the first group's first.
        seeds: That both have.
        gain: Of the second group over the first.
        verdict: As in `Difference`.
    """

    measure: Measure
    groups: tuple[tuple[str, ...], tuple[str, ...]]
    seeds: tuple[int, ...]
    gain: Gain
    verdict: str | None


def value_of(run: ComparedRun, measure: Measure) -> float | None:
    """A measure of a run; None where it was not measured."""
    return _value(at(run.metrics, measure.key))


def measured(runs: Sequence[ComparedRun]) -> list[Measure]:
    """Measures that at least one of the runs has."""
    return [m for m in MEASURES if any(value_of(run, m) is not None for run in runs)]


def differences(base: ComparedRun, other: ComparedRun) -> list[Difference]:
    """All measures that both runs have, the other against the base; intervals over their common views."""
    found = []
    for measure in MEASURES:
        of_views = None if measure.in_view is None else _over_views(measure, base, other)
        a, b = value_of(base, measure), value_of(other, measure)
        if of_views is not None:
            gain, views = of_views
            found.append(Difference(measure, other.name, views, gain, _verdict(gain, measure)))
        elif measure.in_view is None and a is not None and b is not None:
            found.append(Difference(measure, other.name, 0, Gain(b - a, None, (b - a,)), None))
    return found


def repeats(runs: Sequence[ComparedRun]) -> list[list[ComparedRun]]:
    """Runs in groups that differ in nothing but their seed, in the order of their first run.

    A run that does not say how it was made (no stamps) is a group of its own.
    """
    groups: dict[str, list[ComparedRun]] = {}
    for run in runs:
        if not run.config:
            groups[run.name] = [run]
            continue
        config = {key: value for key, value in run.config.items() if key != SEED}
        code = {stage: at(stamp, "identity.code") for stage, stamp in run.stamps.items()}
        groups.setdefault(repr((sorted(config.items()), sorted(code.items()))), []).append(run)
    return list(groups.values())


def seed_differences(runs: Sequence[ComparedRun]) -> list[SeedDifference]:
    """Every group of repeats against the first, where they share two seeds or more."""
    first, *others = repeats(runs)
    found = []
    for group in others:
        by_seed = [{_seed(run): run for run in g} for g in (first, group)]
        seeds = tuple(sorted(s for s in by_seed[0] if s in by_seed[1] and s is not None))
        if len(seeds) < 2:
            continue
        for measure in MEASURES:
            a, b = ([value_of(g[s], measure) for s in seeds] for g in by_seed)
            if None in a or None in b:
                continue
            gain = paired_gain([v for v in b if v is not None], [v for v in a if v is not None])
            names = tuple(r.name for r in first), tuple(r.name for r in group)
            found.append(SeedDifference(measure, names, seeds, gain, _verdict(gain, measure)))
    return found


def _over_views(measure: Measure, base: ComparedRun, other: ComparedRun) -> tuple[Gain, int] | None:
    """The paired difference and how many views it is of; None where no view has the measure in both runs."""
    assert measure.in_view is not None
    there, here = ((r.moving if measure.of_moving else r.still) for r in (base, other))
    pairs: list[tuple[ViewKey, float, float]] = []
    for key in common_views(there, here):
        a, b = _value(at(there[key], measure.in_view)), _value(at(here[key], measure.in_view))
        if a is not None and b is not None:
            pairs.append((key, a, b))
    if not pairs:
        return None
    times = [_time(there[key], key) for key, _, _ in pairs]
    cameras = len({camera for (camera, _), _, _ in pairs})
    gain = gain_over_time([b for _, _, b in pairs], [a for _, a, _ in pairs], times, cameras)
    return gain, len(pairs)


def _verdict(gain: Gain, measure: Measure) -> str | None:
    if gain.nothing:
        return "same"
    if gain.half is None:
        return None
    side = gain.side() * (-1 if measure.low_is_good else 1)
    return {1: "better", -1: "worse", 0: "open"}[side]


def _time(row: dict[str, Any], key: ViewKey) -> float:
    """When a view was taken; of a picture at rest its place in the sweep."""
    time = _value(row.get("time"))
    return float(key[1]) if time is None else time


def _seed(run: ComparedRun) -> int | None:
    seed = run.metrics.get("seed")
    return seed if isinstance(seed, int) else None


def _value(value: Any) -> float | None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and value == value and abs(value) != float("inf") else None
