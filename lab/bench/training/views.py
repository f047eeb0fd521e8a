"""`bench views`: how many moving cameras a scene needs (DeVRF, appendix, "Ablation on the number of views")."""

from collections.abc import Sequence
from pathlib import Path

from devrf.lab.bench.bench_charts import Panel, chart, seed_curves
from devrf.lab.bench.bench_rows import Row
from devrf.lab.bench.training.trainings import Bench, score_rows

PAPER = (
    "the paper (figure, five scenes of its own): quality rises with the number of views and is almost "
    "saturated at six; four come close to six"
)


def run_views(bench: Bench, seeds: Sequence[int], json_path: Path) -> list[Row]:
    """Train with one camera, two, … all of them; print, draw and write what came of it.

    Motion alone: the scene at rest is that of all of them, also where fixed cameras teach it
    (`reconstruct/sampling/plates.py`).
    """
    cameras = list(dict.fromkeys(f.camera_name for f in bench.scene.dynamic if f.split == "train"))
    results = {
        count: [_trained(bench, seed, cameras[:count]) for seed in seeds]
        for count in range(1, len(cameras) + 1)
    }
    rows = [row for count, found in results.items() for row in score_rows(f"views/{count}", found)]
    scene = bench.run.config.name
    blocks = {
        "whole picture": lambda r: r["test"],
        "where it moves": lambda r: r["test_moving"],
        "where it moves, at rest": lambda r: r["static_baseline"]["test_moving"],
    }
    curves = [
        curve
        for name, of in blocks.items()
        for curve in seed_curves(
            name, {n - 1: [of(r)["psnr"] for r in found] for n, found in results.items()}
        )
    ]
    panel = Panel(curves, "moving cameras", "PSNR of test views, dB", ticks=[str(n) for n in results])
    drawn = chart(json_path.with_suffix(".png"), [[panel]], scene)
    bench.run.talk.say(PAPER)
    title = f"Number of moving cameras, {scene}"
    return bench.publish(title, rows, json_path, seeds, drawn, benchmark="views", cameras=cameras)


def _trained(bench: Bench, seed: int, cameras: Sequence[str]) -> dict:
    options = bench.options(seed=seed)
    return bench.motion(f"views{len(cameras)}", bench.rest(options.canonical), options.motion, cameras)
