"""`bench views`: how many moving cameras a scene needs (DeVRF, appendix, "Ablation on the number of views")."""

from collections.abc import Sequence
from pathlib import Path

from devrf.pipelines.bench.charts import lines
from devrf.pipelines.bench.rows import Row, print_rows, say_files, write_rows
from devrf.pipelines.bench.trainings import Bench, about, score_rows


def run_views(bench: Bench, seeds: Sequence[int], json_path: Path) -> list[Row]:
    """Train with one camera, two, … all of them; print, draw and write what came of it."""
    cameras = list(dict.fromkeys(f.camera_name for f in bench.scene.dynamic if f.split == "train"))
    results = {
        count: [_trained(bench, seed, cameras[:count]) for seed in seeds]
        for count in range(1, len(cameras) + 1)
    }
    rows = [row for count, found in results.items() for row in score_rows(f"views/{count}", found)]
    print_rows(bench.run.talk, f"Number of moving cameras, {bench.run.config.name}", rows)
    bench.run.talk.say(
        "the paper (figure, five scenes of its own): quality rises with the number of views and is almost "
        "saturated at six; four come close to six"
    )
    write_rows(json_path, rows, benchmark="views", cameras=cameras, **about(bench, seeds))
    series = {
        "whole picture": {n: [r["test"]["psnr"] for r in found] for n, found in results.items()},
        "where it moves": {n: [r["test_moving"]["psnr"] for r in found] for n, found in results.items()},
        "where it moves, at rest": {
            n: [r["static_baseline"]["test_moving"]["psnr"] for r in found] for n, found in results.items()
        },
    }
    chart = lines(
        json_path.with_suffix(".png"),
        series,
        "moving cameras",
        "PSNR of test views, dB",
        bench.run.config.name,
    )
    say_files(bench.run.talk, json_path, chart)
    return rows


def _trained(bench: Bench, seed: int, cameras: Sequence[str]) -> dict:
    options = bench.options(seed=seed)
    return bench.motion(f"views{len(cameras)}", bench.rest(options.canonical), options.motion, cameras)
