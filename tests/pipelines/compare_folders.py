"""Run folders that can be compared: each with every artifact and sixteen test views, made without a run."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from tests.pipelines.report_folder import write_json, write_run

from devrf.pipelines.stages import stage_names

VIEWS = 16
CAMERA = "wit<b>ness"


def write_two_runs(folder: Path, worse_db: float = 1.0) -> tuple[Path, Path]:
    """Two runs of one scene: the second was trained with fewer rays, and is `worse_db` below the first."""
    first, second = folder / "one", folder / "two"
    write_run(first)
    _more_views(first, 25.0)
    shutil.copytree(first, second)
    _more_views(second, 25.0 - worse_db)
    set_config(first, {"preset": "tiny", "reconstruct.rays": None, "reconstruct.seed": 0})
    set_config(second, {"preset": "tiny", "reconstruct.rays": 512, "reconstruct.seed": 0})
    return first, second


def set_config(run: Path, config: dict[str, Any], code: str = "a") -> None:
    """Let every stage say that it was made of this configuration."""
    for stage in stage_names():
        stamp = run / stage / "stamp.json"
        if stamp.is_file():
            identity = {"config": config, "rooms": {"reconstruct": code}}
            write_json(stamp, json.loads(stamp.read_text()) | {"identity": identity})


def edit_metrics(run: Path, **values: Any) -> None:
    """Set dotted keys of evaluate/metrics.json; None takes one away."""
    file = run / "evaluate/metrics.json"
    metrics = json.loads(file.read_text())
    for key, value in values.items():
        *path, last = key.split("__")
        block = metrics
        for step in path:
            block = block[step]
        block[last] = value
        if value is None:
            del block[last]
    write_json(file, metrics)


def _more_views(run: Path, psnr: float) -> None:
    """Test views over time whose PSNR scatters around `psnr` from picture to picture, alike in all runs."""
    rng = np.random.default_rng(3)
    scatter = rng.normal(0, 0.3, VIEWS)
    own = np.random.default_rng(round(1000 * psnr)).normal(0, 0.1, VIEWS)
    views = run / f"evaluate/views/{CAMERA}"
    rows = []
    for n in range(VIEWS):
        for kind in ("true", "rendered"):
            there = views / f"{n:06d}_{kind}.png"
            if not there.exists():
                shutil.copy(views / f"000000_{kind}.png", there)
        value = psnr + scatter[n] + own[n]
        rows.append(
            {"camera": CAMERA, "index": n, "time": n / (VIEWS - 1), "time_s": n / 16, "psnr": value, "ssim": 0.8,
             "moving": {"psnr": value - 2, "ssim": 0.7},
             "true": f"views/{CAMERA}/{n:06d}_true.png", "rendered": f"views/{CAMERA}/{n:06d}_rendered.png"}
        )  # fmt: skip
    file = run / "evaluate/metrics.json"
    metrics = json.loads(file.read_text())
    still = [row for row in metrics["per_view"] if row["time"] is None]
    mean = float(np.mean([row["psnr"] for row in rows]))
    metrics["test"] |= {"psnr": mean, "ssim": 0.8}
    metrics["test_moving"] |= {"psnr": mean - 2, "ssim": 0.7}
    write_json(file, metrics | {"per_view": rows + still})
