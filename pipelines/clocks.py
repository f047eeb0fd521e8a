"""Clocks on disk, as stage `sync` and the check by geometry write them."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from devrf.calibration.clocks.equations import Clock


def clock_dict(clock: Clock) -> dict[str, Any]:
    """A clock as it is written to `sync.json` and `clock_check.json`."""
    return {
        "offset_s": clock.offset_s,
        "drift_ppm": clock.drift_ppm,
        "std_s": clock.std_s if math.isfinite(clock.std_s) else None,
        "method": clock.method,
        "confidence": clock.confidence,
        "basis": clock.basis,
    }


def curve_dict(lags_s: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]) -> dict[str, list[float]]:
    """How well two clips agree at each lag, as it is written to `curves.json` and `clock_check.json`."""
    return {"lags_s": [round(float(x), 6) for x in lags_s], "values": [round(float(x), 5) for x in values]}


def read_clocks(path: Path) -> dict[str, tuple[float, float]]:
    """Camera -> (offset_s, rate): true time = offset_s + rate * file time, on the first camera's clock.

    Clips that only show the board have clocks of their own, under their own names. Empty without the file.
    """
    if not path.is_file():
        return {}
    content = json.loads(path.read_text())
    clocks = {**content.get("joint", {}).get("cameras", {}), **content["cameras"]}
    return {name: (c["offset_s"], 1 + 1e-6 * c["drift_ppm"]) for name, c in clocks.items()}


def read_contradictions(run_dir: Path) -> dict[str | None, float | None]:
    """Largest contradiction between pairs of cameras, seconds: of those that are trained on (None), of test cameras."""
    content = json.loads((run_dir / "sync" / "sync.json").read_text())
    tests = {name: entry["loop_s"] for name, entry in content.get("tests", {}).items()}
    return {None: content.get("loop_s"), **tests}


def read_sync(run_dir: Path) -> dict[str, Clock]:
    """The moving cameras' clocks as stage `sync` wrote them."""
    cameras = json.loads((run_dir / "sync" / "sync.json").read_text())["cameras"]
    return {
        name: Clock(**{**entry, "std_s": math.inf if entry["std_s"] is None else entry["std_s"]})
        for name, entry in cameras.items()
    }
