"""`bench parts`: what each part of the model earns, by trainings without it, paired by seed."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from devrf.lab.bench.bench_charts import gains as gains_chart
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.trainings import Bench, score_rows, spread
from devrf.pipelines.tables import print_table
from devrf.reconstruct import parts as parts_module
from devrf.reconstruct.evaluate import motion_psnr
from devrf.reconstruct.options import Options
from devrf.reconstruct.paired import Gain, paired_gain
from devrf.reconstruct.parts import PARTS, Part
from devrf.reconstruct.rest_model import RestModel

WHOLE = "whole"
MEASURES = {"psnr_moving": "dB", "psnr": "dB", "lpips_vgg": "", "seconds": "s", "model_mb": "MB"}
LOW_IS_GOOD = ("lpips_vgg", "seconds", "model_mb")
WORDS = {"psnr_moving": "PSNR where it moves", "psnr": "PSNR of test views", "lpips_vgg": "LPIPS (VGG)"}
EARNS, SAVES, COSTS, UNTOLD, NOTHING = (
    "earns its place", "saves time", "costs", "cannot be told", "does nothing here"
)  # fmt: skip


@dataclass(frozen=True)
class Judged:
    """What came of a part: by measure what it adds, and the verdict with the measure that decided."""

    part: Part
    gains: dict[str, Gain]

    @property
    def verdict(self) -> str:
        """The first measure that can tell decides: PSNR, then LPIPS, then whether it saves time.

        Either score may decide, so each is asked more strictly (Bonferroni): both together are wrong in 5 % of cases.
        """
        found = self.gains
        scores = [name for name in self.order if name in found]
        if all(found[name].nothing for name in scores):
            return NOTHING
        for name in scores:
            if side := found[name].side(len(scores)):
                better = (side < 0) == (name in LOW_IS_GOOD)
                return f"{EARNS if better else COSTS} ({WORDS[name]})"
        return SAVES if found["seconds"].side() < 0 else UNTOLD

    @property
    def order(self) -> tuple[str, ...]:
        """Parts of the scene at rest shape the whole picture, those of the motion what moves."""
        return ("psnr", "lpips_vgg") if self.part.stage == "rest" else ("psnr_moving", "lpips_vgg")

    def as_dict(self) -> dict[str, Any]:
        """As written to the JSON of results."""
        found = {name: asdict(gain) for name, gain in self.gains.items()}
        return {"stage": self.part.stage, "what": self.part.what, "verdict": self.verdict, "gains": found}


def run_parts(bench: Bench, names: Sequence[str], seeds: Sequence[int], json_path: Path) -> list[Row]:
    """Train the whole, and without each part, for every seed; print, draw and write what came of it.

    Args:
        bench: The scene.
        names: Of the parts.
        seeds: One pair of trainings per part and seed.
        json_path: Where the rows go; the chart is drawn beside it.
    """
    talk, whole_options = bench.run.talk, bench.options()
    chosen = [part for part in PARTS if part.name in names]
    used = [part for part in chosen if part.in_use(bench.scene, whole_options)]
    whole = []
    for seed in seeds:
        options = bench.options(seed=seed)
        whole.append(_trained(bench, WHOLE, bench.rest(options.canonical), options))
    judged = []
    for part in used:
        judged.append(Judged(part, gains_of(whole, [_without(bench, part, seed) for seed in seeds])))
        talk.say(f"{part.name}: {judged[-1].verdict}")
    rows = score_rows(f"parts/{WHOLE}", whole) + [row for one in judged for row in _rows(one)]
    title = f"{bench.run.config.name}, {bench.run.config.preset}, {len(seeds)} seeds"
    headings = ("", "moving, dB", "PSNR, dB", "LPIPS", "s", "MB", "verdict*")
    lines = [
        (
            one.part.name,
            *(_cell(one.gains.get(m), 3 if m == "lpips_vgg" else 2) for m in MEASURES),
            one.verdict,
        )
        for one in judged
    ]
    print_table(talk, f"What parts add, {title}", headings, lines)
    unused = [part.name for part in chosen if part not in used]
    if unused:
        talk.say(f"not in use here: {', '.join(unused)}")
    labels = {name: f"{words}, {MEASURES[name] or 'low is good'}" for name, words in WORDS.items()}
    drawn = {
        one.part.name: {labels[name]: one.gains[name] for name in labels if name in one.gains}
        for one in judged
    }
    chart = gains_chart(json_path.with_suffix(".png"), drawn, title) if judged else None
    about = {"parts": {one.part.name: one.as_dict() for one in judged}, "not_in_use": unused}
    return bench.publish(None, rows, json_path, seeds, chart, benchmark="parts", **about)


def gains_of(whole: Sequence[dict[str, Any]], without: Sequence[dict[str, Any]]) -> dict[str, Gain]:
    """What a part adds, by measure; those that could not be computed are left out."""
    found = {}
    for name in MEASURES:
        with_it, without_it = ([_value(r, name) for r in of] for of in (whole, without))
        if None not in with_it and None not in without_it:
            found[name] = paired_gain(with_it, without_it)
    return found


def _value(result: dict[str, Any], measure: str) -> Any:
    if measure in ("seconds", "model_mb"):
        return result[measure]
    return motion_psnr(result)[0] if measure == "psnr_moving" else result["test"][measure]


def _without(bench: Bench, part: Part, seed: int) -> dict[str, Any]:
    """Trained without the part; the scene at rest is shared where the part is one of the motion's."""
    scene, options = part.without(bench.scene, bench.options(seed=seed))
    other = bench if scene is bench.scene else replace(bench, scene=scene, changed_by=parts_module.__name__)
    if part.stage == "motion":
        return _trained(other, part.name, bench.rest(options.canonical), options)
    other = replace(other, out=bench.out / part.name)
    return _trained(other, "motion", other.rest(options.canonical), options)


def _trained(bench: Bench, name: str, rest: RestModel, options: Options) -> dict[str, Any]:
    result = bench.motion(name, rest, options.motion)
    return result | {"seconds": rest.metrics["seconds"] + result["train"]["seconds"]}


def _rows(one: Judged) -> list[Row]:
    rows = []
    for name, unit in MEASURES.items():
        gain, title = one.gains.get(name), f"parts/{one.part.name}/{name}"
        if gain is None:
            rows.append(Row(title, None, unit, why="not computed"))
        else:
            rows.append(Row(title, gain.mean, unit, spread(gain.by_pair)))
    return rows


def _cell(gain: Gain | None, digits: int) -> str:
    """What a part adds, with half its interval."""
    if gain is None:
        return ""
    return f"{gain.mean:+.{digits}f}" + ("" if gain.half is None else f" ±{gain.half:.{digits}f}")
