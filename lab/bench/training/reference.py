"""`bench reference`: the published recipe in full, and the ablation at half size, within a time (benchmarks/gpu.sh)."""

import time
from dataclasses import replace
from pathlib import Path

from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.ablation import PAPER_INWARD, SOURCE_INWARD, ablation_rows, train_variants
from devrf.lab.bench.training.trainings import Bench, score_rows
from devrf.pipelines.runner.run import Run
from devrf.reconstruct.ablation import VARIANTS
from devrf.reconstruct.options import PRESETS

GOALS = {"psnr": 34.3, "ssim": 0.982, "lpips_vgg": 0.0137}  # the paper's means over its five synthetic scenes
PAPER_GPU_GB = 4.6
SHARE = 0.5  # of pictures' sides, voxels' sides and rays, for the ablation
ABLATION_CANONICAL, ABLATION_MOTION = 5000, 100  # iterations: of the scene at rest, and per key time


def run_reference(run: Run, out: Path, json_path: Path, minutes: float) -> list[Row]:
    """Train in full, then what of the ablation time allows; print and write both."""
    until = time.monotonic() + 60 * minutes
    full = Bench.prepare(run, out)
    full = replace(full, out=out / "reference")  # where `bench speed` looks for the preset's models
    options = full.options()
    rest = full.rest(options.canonical)
    result = full.motion("motion", rest, options.motion)
    rows = []
    for row in score_rows("reference", [result], PAPER_INWARD["flow"], SOURCE_INWARD):
        metric = row.name.rsplit("/", 1)[1]
        goal = GOALS.get(metric) if row.name.startswith("reference/test/") else None
        rows.append(row.at_most(goal) if metric.startswith("lpips") else row.at_least(goal))
    peaks = [gb for gb in (rest.metrics["peak_gpu_gb"], result["train"]["peak_gpu_gb"]) if gb is not None]
    why = None if peaks else "trained on a CPU"
    memory = Row(
        "reference/peak_gpu_gb", max(peaks, default=None), "GB", None, PAPER_GPU_GB, SOURCE_INWARD, why=why
    )
    rows += [
        Row("reference/canonical/seconds", rest.metrics["seconds"], "s"),
        Row("reference/canonical/train_psnr", rest.metrics["train_psnr"], "dB"),
        memory.at_most(PAPER_GPU_GB),
        Row("reference/render_fps", result["render_fps"], "pictures/s"),
    ]
    half = Bench.prepare(_halved(run), out / "half")
    trained = train_variants(half, [run.config.reconstruct.seed], until=until)
    rows += ablation_rows(half, trained)
    why = f"not begun within {minutes:g} minutes"
    rows += [Row(f"ablation/{n}/test/psnr", None, "dB", why=why) for n in VARIANTS if n not in trained]
    title, seeds = f"Reference recipe on {run.config.name}", [run.config.reconstruct.seed]
    return full.publish(title, rows, json_path, seeds, benchmark="reference")


def _halved(run: Run) -> Run:
    """The same scene at half the size in every respect."""
    config = run.config
    preset, given = PRESETS[config.preset], config.reconstruct
    shrink = (given.canonical_iterations or preset.canonical.iterations) / preset.canonical.iterations
    motion = given.motion_iterations or sum(preset.motion.iterations)
    half = given.model_copy(
        update={
            "image_scale": SHARE * (given.image_scale or 1.0),
            "resolution": max(16, round(SHARE * (given.resolution or preset.canonical.resolution))),
            "rays": max(64, round(SHARE * (given.rays or preset.motion.rays))),
            "canonical_iterations": max(1, round(shrink * ABLATION_CANONICAL)),
            "motion_iterations": max(5, round(ABLATION_MOTION * motion / sum(preset.motion.iterations))),
        }
    )
    return replace(run, config=config.model_copy(update={"reconstruct": half}))
