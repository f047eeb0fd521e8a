"""`bench methods`: methods for moving scenes on the same data, split and clock, beside what the paper measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.system.errors import DevrfError, InputError
from devrf.capture.system.progress import Progress
from devrf.lab.bench.bench_charts import chart
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.measured import Measured, panels, pareto
from devrf.lab.bench.training.progress_views import Looks
from devrf.lab.bench.training.trainings import Bench, device_name, spread
from devrf.lab.methods.method_table import METHODS, OURS, Regime, Size
from devrf.lab.methods.paper_table import SYNTHETIC, TABLE_1
from devrf.lab.methods.protocol import Method, MethodTask, TimeBudget, TrainedModel
from devrf.pipelines.inputs.flow_clips import flow_estimator
from devrf.reconstruct.storage.checkpoint import Checkpoint

GOAL_FASTER = 20.0  # times, that ours reaches another's quality sooner
SIDE = 240  # pixels of the longer side of a picture beside others


@dataclass(frozen=True)
class Contest:
    """What is compared.

    Attributes:
        names: Of the methods.
        regime, size: As `protocol` says.
        seconds: Of training, of each.
        steps: At most so many iterations of each; None: as many as the time allows.
        seeds: Of everything random.
    """

    names: Sequence[str]
    regime: Regime
    size: Size
    seconds: float
    steps: int | None
    seeds: Sequence[int]

    def folder(self, name: str) -> str:
        """Of a method's training, below its seed's."""
        return f"{name}-{self.regime}-{self.size}-{self.seconds:g}s"


def run_methods(bench: Bench, contest: Contest, json_path: Path) -> list[Row]:
    """Train all, one after the other; rows, chart and pictures are written anew after each.

    Raises:
        InputError: A method cannot do what is asked for; nothing was trained.
    """
    methods = {name: METHODS[name].load() for name in contest.names}
    task = method_task(bench, contest, contest.seeds[0])
    for name, method in methods.items():
        check(name, method, task)
    found: dict[str, list[Measured]] = {}
    failed: dict[str, str] = {}
    rows: list[Row] = []
    for name, method in methods.items():
        try:
            found[name] = [measured(bench, contest, name, method, seed) for seed in contest.seeds]
        except (DevrfError, MemoryError) as error:
            failed[name] = str(error) or type(error).__name__
            bench.run.talk.say(f"{name}: {failed[name]}")
        rows = _written(bench, contest, found, failed, json_path, last=name == contest.names[-1])
    return rows


def check(name: str, method: Method, task: MethodTask) -> None:
    """Refuse what a method cannot do.

    Raises:
        InputError: It has not this regime, or the scene lacks what it needs.
    """
    if task.regime not in method.regimes:
        have = ", ".join(method.regimes)
        raise InputError(
            "regime-unknown", f"--regime {task.regime}: {name} has {have}; leave it out of --methods"
        )
    if task.regime != "dynamic" and not any(f.split == "train" for f in task.scene.static):
        raise InputError(
            "sweep-missing", f"--regime {task.regime} needs a sweep, and the scene has none: --regime dynamic"
        )
    why = method.why_not(task)
    if why is not None:
        raise InputError("method-unfit", f"{name}: {why}; leave it out of --methods")


def method_task(bench: Bench, contest: Contest, seed: int) -> MethodTask:
    config, device = bench.run.config, bench.run.device
    return MethodTask(
        bench.scene,
        bench.flows,
        contest.regime,
        contest.size,
        device,
        seed,
        lambda preset: bench.options(preset, seed=seed),
        partial(flow_estimator, config, bench.run.scene_dir, device),
    )


def measured(bench: Bench, contest: Contest, name: str, method: Method, seed: int) -> Measured:
    """One method trained and scored, now or when it was before."""
    folder = contest.folder(name)

    def train(checkpoint: Checkpoint, progress: Progress) -> dict[str, Any]:
        looks, last = Looks(bench.scene), [0.0]

        def look(model: TrainedModel, seconds: float) -> None:
            last[0] = seconds
            looks.at(partial(_colours, model), seconds)

        budget = TimeBudget(contest.seconds, look, progress, contest.steps)
        model = method.train(method_task(bench, contest, seed), budget)
        result = bench.scores(bench.scene, partial(_colours, model), bench.out / f"seed{seed}" / folder)
        return result | {"looks": looks.taken(), "seconds": last[0], "model_mb": model.megabytes}

    of = bench.fingerprint(name, contest.regime, contest.size, contest.seconds, contest.steps)
    result = bench.once(seed, folder, of, train)
    return Measured(
        name, result | {"train": {"seconds": result["seconds"]}}, result["looks"], result["seconds"]
    )


def _colours(model: TrainedModel, camera: Camera, time: float | None) -> np.ndarray:
    return model.render(camera, time)[0]


def seconds_to(looks: Sequence[dict[str, float]], psnr: float) -> float | None:
    """Seconds of training after which the few views that are looked at reach so many dB; None: never."""
    return next((look["seconds"] for look in looks if look["psnr"] >= psnr), None)


def _written(
    bench: Bench,
    contest: Contest,
    found: dict[str, list[Measured]],
    failed: dict[str, str],
    path: Path,
    last: bool,
) -> list[Row]:
    """Rows, chart and pictures of what there is so far; printed at the end."""
    rows = [row for each in found.values() for row in _rows(each, contest)]
    rows += [Row(f"methods/{name}/test/psnr", None, "dB", why=why) for name, why in failed.items()]
    rows += _still(found) + _reached(found)
    first = [each[0] for each in found.values()]
    drawn = None
    if first:
        title = f"{bench.run.config.name}, {contest.regime}, {contest.size}, {device_name(bench.run.device)}"
        drawn = chart(
            path.with_suffix(".png"), panels(first, published=False), title, sharey="row", sharex="col"
        )
        _beside(bench, contest, list(found), path.with_name(f"{path.stem}-pictures.png"))
    about = {
        "regime": contest.regime,
        "size": contest.size,
        "seconds": contest.seconds,
        "clock": "processor seconds" if bench.run.device == "cpu" else "seconds",
        "curves": {name: each[0].looks for name, each in found.items()},
        "front": {
            axis: [one.name for one in pareto(first, axis)] for axis in ("seconds", "megabytes", "fps")
        },
    }
    title = f"Methods, {bench.run.config.name}, {contest.regime}" if last else None
    return bench.publish(
        title, rows, path, contest.seeds, drawn if last else None, benchmark="methods", **about
    )


def _rows(each: Sequence[Measured], contest: Contest) -> list[Row]:
    """Of one method: the first seed's rows, with the spread of PSNR over seeds and the paper's number beside it."""
    paper = SYNTHETIC.get((each[0].name, contest.regime))
    rows = each[0].rows("methods")
    whole = f"methods/{each[0].name}/test/psnr"
    of = [one.psnr for one in each]
    anchor, source = (None, None) if paper is None else (paper.psnr, TABLE_1)
    mean = Row(whole, float(np.mean(of)), "dB", spread(of), anchor, source)
    return [mean if row.name == whole else row for row in rows]


def _still(found: dict[str, list[Measured]]) -> list[Row]:
    """What the best scene at rest, by any method, scores if it is shown at all times."""
    rows = []
    for block in ("test", "test_moving"):
        scores = [each[0].result["static_baseline"][block]["psnr"] for each in found.values()]
        known = [score for score in scores if score is not None]
        if known:
            rows.append(Row(f"methods/nothing moves/{block}/psnr", max(known), "dB"))
    return rows


def _reached(found: dict[str, list[Measured]]) -> list[Row]:
    """How much sooner ours reaches each other's final quality, by the views that are looked at."""
    ours = found.get(OURS)
    if ours is None:
        return []
    rows = []
    for name, (other, *_) in found.items():
        if name.startswith("devrf") or not other.looks:
            continue
        final = other.looks[-1]["psnr"]
        mine = seconds_to(ours[0].looks, final)
        row = Row(
            f"methods/{OURS} sooner than {name}", None, "times", why=f"{OURS} never reaches {final:.1f} dB"
        )
        if mine:
            row = replace(row, value=other.seconds / mine, why=None).at_least(GOAL_FASTER)
        rows.append(row)
        theirs = seconds_to(other.looks, ours[0].looks[-1]["psnr"])
        reach = Row(f"methods/{name} to the quality of {OURS}", theirs, "s")
        rows.append(reach if theirs else replace(reach, why=f"not reached in {other.seconds:.0f} s"))
    return rows


def _beside(bench: Bench, contest: Contest, names: Sequence[str], path: Path) -> None:
    """The same test view as it is and as each method renders it, errors below."""
    tiles: list[tuple[Path, Path]] = []
    for name in names:
        errors = (bench.out / f"seed{contest.seeds[0]}" / contest.folder(name)).rglob("*_error.png")
        views = sorted(errors, key=lambda path: (path.name, path))  # by moment: the middle one moves
        if views:
            error = views[len(views) // 2]
            tiles.append((error.with_name(error.name.replace("_error", "_rendered")), error))
    if not tiles:
        return
    true = tiles[0][0].with_name(tiles[0][0].name.replace("_rendered", "_true"))
    tops = [_small(true), *(_small(top) for top, _ in tiles)]
    blank = np.full_like(tops[0], 255)
    bottoms = [blank, *(_small(error) for _, error in tiles)]
    Image.fromarray(np.concatenate([np.concatenate(tops, 1), np.concatenate(bottoms, 1)])).save(path)


def _small(path: Path) -> np.ndarray:
    picture = Image.fromarray(read_pixels(path)[..., :3])
    scale = SIDE / max(picture.size)
    return np.asarray(picture.resize((round(picture.width * scale), round(picture.height * scale))))
