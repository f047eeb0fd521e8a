"""The measures of several runs, and which of their differences are more than chance."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from devrf.pipelines.compare.compared_runs import ComparedRun, common_views
from devrf.pipelines.report.run_reader import at, is_number
from devrf.reconstruct.evaluation.paired import Gain, gain_over_time, paired_gain

SEED = "reconstruct.seed"


@dataclass(frozen=True)
class Metric:
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
    Metric("test_moving.psnr", "PSNR where it moves", "dB", 2, "moving.psnr"),
    Metric("test_moving.ssim", "SSIM where it moves", "", 4, "moving.ssim"),
    Metric(
        "test_moving_retimed.psnr",
        "PSNR where it moves, with the test clock that was found",
        "dB",
        2,
        "retimed.psnr",
    ),
    Metric("test.psnr", "PSNR, test views", "dB", 2, "psnr"),
    Metric("test.ssim", "SSIM, test views", "", 4, "ssim"),
    Metric("test.lpips_vgg", "LPIPS (VGG), test views", "", 4, "lpips_vgg", low_is_good=True),
    Metric("test.lpips_alex", "LPIPS (Alex), test views", "", 4, "lpips_alex", low_is_good=True),
    Metric("test_rest.psnr", "PSNR, what stands, test cameras", "dB", 2),
    Metric("test_static.psnr", "PSNR, held-out sweep", "dB", 2, "psnr", of_moving=False),
    Metric("test_static.ssim", "SSIM, held-out sweep", "", 4, "ssim", of_moving=False),
    Metric("train.total_s", "training", "s", 0, low_is_good=True),
    Metric("train.peak_rss_gb", "peak main memory, training", "GB", 2, low_is_good=True),
    Metric("train.peak_gpu_gb", "peak GPU memory, training", "GB", 2, low_is_good=True),
    Metric("model_mb", "model", "MB", 1, low_is_good=True),
    Metric("render_fps", "pictures per second", "fps", 2),
)


@dataclass(frozen=True)
class Difference:
    """A run against the first one, or a group of repeated runs against the first group.

    Attributes:
        measure: What was measured.
        runs, against: Names of the runs.
        pairs: Views that both have, or seeds; none where the measure is one number of each run.
        gain: The mean difference and its interval; of what is no mean over pairs only the difference.
    """

    measure: Metric
    runs: tuple[str, ...]
    against: tuple[str, ...]
    pairs: tuple[Any, ...]
    gain: Gain

    @property
    def verdict(self) -> str | None:
        """better, worse, or `open`: the interval holds 0; `same`: no pair differs; None: there is no interval."""
        if not self.pairs:
            return None
        if self.gain.nothing:
            return "same"
        if self.gain.half is None:
            return None
        return {1: "better", -1: "worse", 0: "open"}[
            self.gain.side() * (-1 if self.measure.low_is_good else 1)
        ]


def value_of(run: ComparedRun, measure: Metric) -> float | None:
    """A measure of a run; None where it was not measured."""
    value = at(run.metrics, measure.key)
    return float(value) if is_number(value) else None


def differences(base: ComparedRun, other: ComparedRun) -> Iterator[Difference]:
    """All measures that both runs have, the other against the base; intervals over their common views."""
    for measure in MEASURES:
        names = (other.name,), (base.name,)
        a, b = value_of(base, measure), value_of(other, measure)
        if measure.in_view is None:
            if a is not None and b is not None:
                yield Difference(measure, *names, (), Gain(b - a, None, (b - a,)))
            continue
        there, here = base.views[measure.of_moving], other.views[measure.of_moving]
        both = {
            k: (at(there[k], measure.in_view), at(here[k], measure.in_view))
            for k in common_views(there, here)
        }
        both = {k: values for k, values in both.items() if all(map(is_number, values))}
        if both:
            times = [there[k].get("time") for k in both]
            order = [k[1] if time is None else time for k, time in zip(both, times, strict=True)]
            without, with_it = zip(*both.values(), strict=True)
            yield Difference(measure, *names, tuple(both), gain_over_time(with_it, without, order))


def seed_differences(runs: Sequence[ComparedRun]) -> Iterator[Difference]:
    """Every group of runs that differ in nothing but their seed against the first, where they share two or more."""
    groups: dict[str, dict[int, ComparedRun]] = {}
    for run in runs:
        config = {key: value for key, value in run.config.items() if key != SEED}
        code = {stage: at(stamp, "identity.rooms") for stage, stamp in run.stamps.items()}
        made_of = repr((sorted(config.items()), sorted(code.items()))) if config else run.name
        groups.setdefault(made_of, {})[run.metrics.get("seed", 0)] = run
    first, *others = groups.values()
    for group in others:
        seeds = sorted(first.keys() & group.keys())
        for measure in MEASURES if len(seeds) > 1 else ():
            found = [(value_of(first[seed], measure), value_of(group[seed], measure)) for seed in seeds]
            pairs = [(a, b) for a, b in found if a is not None and b is not None]
            if len(pairs) == len(seeds):
                names, against = (tuple(run.name for run in of.values()) for of in (group, first))
                without, with_it = zip(*pairs, strict=True)
                yield Difference(measure, names, against, tuple(seeds), paired_gain(with_it, without))
