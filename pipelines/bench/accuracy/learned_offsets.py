"""`bench sync --only learned`: clocks put wrong, and what learning them with the motion brings back.

A simulated data set with exact times, its training cameras' times falsified; the scene at rest is shared, the motion
is trained anew for every case by `train_deformation`, as the stage does it.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from devrf.capture.scene import Scene
from devrf.capture.simulate.dataset import simulate_dataset
from devrf.capture.simulate.dataset_options import DatasetOptions
from devrf.pipelines.bench.accuracy.cases import Cases
from devrf.pipelines.bench.rows import Row
from devrf.pipelines.bench.trainings import Bench
from devrf.pipelines.cli_options import configured
from devrf.pipelines.runner.plan import Choice
from devrf.pipelines.runner.run import Run
from devrf.pipelines.stages import STAGES
from devrf.reconstruct.clocks import LearnedClock, with_clocks

FPS = 30.0  # at which the set's times are taken to be filmed: 10 ms are 0.3 pictures
SIZE, OPTIONS = (100, 100), DatasetOptions(times=20, motion_scale=0.4, static_views=80, test_views_per_time=1)
WRONG_S = 0.010
CASES: dict[str, tuple[dict[int, float], bool]] = {
    "true clocks": ({}, False),
    "true clocks, learned": ({}, True),
    "one wrong": ({1: WRONG_S}, False),
    "one wrong, learned": ({1: WRONG_S}, True),
    "two wrong, learned": ({1: WRONG_S, 2: -WRONG_S}, True),
}
"""By case: what is added to the times of which training camera, and whether clocks are learned."""
LEFT_MS, LEFT_DB = 1.0, 0.1  # most that may be left of the error, and of what it costs


def learned(cases: Cases) -> list[Row]:
    """Error of the clocks after training, and PSNR of test views, with true and with wrong times."""
    folder = cases.out / "learned"
    made = simulate_dataset(folder / "arm", "arm", size=SIZE, options=OPTIONS)
    config, scene_dir = configured(made.scene_yaml, "tiny", ["reconstruct.resolution=64"])
    bench = Bench.prepare(Run(config, scene_dir, STAGES, Choice(), cases.talk, "cpu"), folder / "trainings")
    bench = replace(bench, scene=_as_filmed(bench.scene))
    names = list(dict.fromkeys(f.camera_name for f in bench.scene.dynamic if f.split == "train"))
    rest = bench.rest(bench.options().canonical)
    rows, psnr, seconds = [_speed(bench)], {}, {}
    for case, (wrong, learn) in CASES.items():
        errors = {names[n]: error_s for n, error_s in wrong.items()}
        falsified = {name: LearnedClock(error_s, None, 0.0) for name, error_s in errors.items()}
        scene = with_clocks(bench.scene, falsified)
        options = bench.options(learn_clocks=learn).motion
        result = replace(bench, scene=scene).motion(case.replace(", ", "-").replace(" ", "-"), rest, options)
        psnr[case], seconds[case] = result["test"]["psnr"], result["train"]["seconds"]
        rows.append(Row(f"sync/learned/{case}/test psnr", psnr[case], "dB"))
        if learn:
            left = _left_ms(errors, result["train"]["clocks"])
            rows.append(Row(f"sync/learned/{case}/largest clock error", left, "ms").at_most(LEFT_MS))
            lost = psnr["true clocks"] - psnr[case]
            rows.append(Row(f"sync/learned/{case}/psnr lost", lost, "dB").at_most(LEFT_DB))
    ratio = seconds["true clocks, learned"] / seconds["true clocks"]
    return [*rows, Row("sync/learned/seconds, of those without", ratio, "")]


def _as_filmed(scene: Scene) -> Scene:
    """The same pictures, one every 1 / FPS seconds."""
    span_s = (len({f.time for f in scene.dynamic}) - 1) / FPS
    dynamic = tuple(replace(f, time_s=span_s * (f.time or 0.0)) for f in scene.dynamic)
    return replace(scene, t0_s=0.0, t1_s=span_s, dynamic=dynamic)


def _speed(bench: Bench) -> Row:
    """Mean length of the flow where it is longer than a tenth of a pixel."""
    lengths = [np.linalg.norm(c.flow.astype(np.float32), axis=-1)[c.valid] for c in bench.flows.values()]
    moving = np.concatenate(lengths)
    return Row("sync/learned/motion", float(moving[moving > 0.1].mean()), "pixels per picture")


def _left_ms(errors_s: Mapping[str, float], clocks: Mapping[str, Mapping[str, Any]]) -> float:
    return max(1000 * abs(errors_s.get(name, 0.0) + clock["offset_s"]) for name, clock in clocks.items())
