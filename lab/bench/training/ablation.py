"""`bench ablation`: what each part of the motion's training is worth (DeVRF, Tables 2 and 3)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from devrf.lab.bench.bench_charts import Curve, Panel, chart, seed_curves
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.ablation_variants import VARIANTS, ablated
from devrf.lab.bench.training.trainings import Bench, score_rows, spread

SOURCE_INWARD = "DeVRF, Table 2: mean of its five synthetic scenes (other data; 400x400, RTX 3090)"
SOURCE_FORWARD = "DeVRF, Table 3: mean of its two real forward-facing scenes (other data; 540x960, RTX 3090)"
PAPER_INWARD = {
    "base": {"psnr": 22.44, "ssim": 0.887, "lpips_vgg": 0.1173},
    "c2f": {"psnr": 31.97, "ssim": 0.975, "lpips_vgg": 0.0185},
    "tv": {"psnr": 32.73, "ssim": 0.963, "lpips_vgg": 0.0172},
    "cycle": {"psnr": 33.97, "ssim": 0.981, "lpips_vgg": 0.0142},
    "flow": {"psnr": 34.29, "ssim": 0.982, "lpips_vgg": 0.0137},
}
PAPER_FORWARD = {  # means of plant and rabbit
    "base": {"psnr": 25.855, "ssim": 0.928, "lpips_vgg": 0.1011},
    "c2f": {"psnr": 29.32, "ssim": 0.959, "lpips_vgg": 0.0611},
    "tv": {"psnr": 30.585, "ssim": 0.9655, "lpips_vgg": 0.0459},
    "cycle": {"psnr": 31.52, "ssim": 0.972, "lpips_vgg": 0.0389},
    "flow": {"psnr": 32.03, "ssim": 0.9735, "lpips_vgg": 0.0364},
}
C2F_GAIN_DB = 2.0  # that coarse-to-fine has to bring, at any size


def run_ablation(
    bench: Bench, seeds: Sequence[int], json_path: Path, only: Sequence[str] = VARIANTS
) -> list[Row]:
    """Train variants for every seed; print, draw and write what came of it.

    Args:
        bench: The scene.
        seeds: One training per variant and seed.
        json_path: Where the rows go; the chart is drawn beside it.
        only: Names of the variants.
    """
    results = _train_variants(bench, seeds, only)
    rows, (paper, _) = _rows(bench, results), _paper(bench)
    scene = bench.run.config.name
    ticks = [name if name in ("base", "c2f") else f"+{name}" for name in results]
    psnr = {n: [r["test"]["psnr"] for r in found] for n, found in enumerate(results.values())}
    theirs = [(n + 0.2, paper[name]["psnr"]) for n, name in enumerate(results)]
    curves = [*seed_curves("ours, mean", psnr), Curve("the paper (other data)", theirs, "paper")]
    panel = Panel(curves, y_label="PSNR of test views, dB", ticks=ticks)
    title = f"{scene}, {len(seeds)} seed{'s' if len(seeds) > 1 else ''}"
    drawn = chart(json_path.with_suffix(".png"), [[panel]], title)
    return bench.publish(f"Ablation of {scene}", rows, json_path, seeds, drawn, benchmark="ablation")


def _train_variants(
    bench: Bench, seeds: Sequence[int], only: Sequence[str]
) -> dict[str, list[dict[str, Any]]]:
    """Results by variant, one per seed."""
    results: dict[str, list[dict[str, Any]]] = {}
    for seed in seeds:
        options = bench.options(seed=seed)
        published = bench.options("reference", seed=seed).motion
        rest = bench.rest(options.canonical)
        for name, variant in ablated(options.motion, published).items():
            if name in only:
                results.setdefault(name, []).append(bench.motion(name, rest, variant))
    return results


def _rows(bench: Bench, results: dict[str, list[dict[str, Any]]]) -> list[Row]:
    """Scores of every variant beside the paper's, and what each part brings."""
    paper, source = _paper(bench)
    rows = []
    for name, found in results.items():
        rows += score_rows(f"ablation/{name}", found, paper[name], source)
    trained = [name for name in VARIANTS if name in results]
    for before, name in zip(trained, trained[1:], strict=False):
        pairs = zip(results[name], results[before], strict=False)  # seed by seed
        gains = [a["test"]["psnr"] - b["test"]["psnr"] for a, b in pairs]
        published = round(paper[name]["psnr"] - paper[before]["psnr"], 3)
        title, apart = f"ablation/{before} to {name}/psnr", spread(gains)
        row = Row(title, float(np.mean(gains)), "dB", apart, published, source)
        rows.append(row.at_least(C2F_GAIN_DB if name == "c2f" else 0.0 - (apart or 0.0)))
    return rows


def _paper(bench: Bench) -> tuple[dict[str, dict[str, float]], str]:
    forward = bench.scene.kind == "forward"
    return (PAPER_FORWARD, SOURCE_FORWARD) if forward else (PAPER_INWARD, SOURCE_INWARD)
