"""Clocks on disk: how they are written, and which ones are in use."""

import json
import math
from pathlib import Path
from typing import Any

from devrf.calibration.clock_equations import Clock


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


def read_clocks(path: Path) -> dict[str, tuple[float, float]]:
    """Camera -> (offset_s, rate): true time = offset_s + rate * file time, on the first camera's clock.

    Clips that only show the board have clocks of their own, under their own names. Empty without the file.
    """
    if not path.is_file():
        return {}
    content = json.loads(path.read_text())
    clocks = {**content.get("joint", {}).get("cameras", {}), **content["cameras"]}
    return {name: (c["offset_s"], 1 + 1e-6 * c["drift_ppm"]) for name, c in clocks.items()}


def read_sync(run_dir: Path) -> dict[str, Clock]:
    """The moving cameras' clocks as stage `sync` wrote them."""
    cameras = json.loads((run_dir / "sync" / "sync.json").read_text())["cameras"]
    return {
        name: Clock(**{**entry, "std_s": math.inf if entry["std_s"] is None else entry["std_s"]})
        for name, entry in cameras.items()
    }


def clocks_in_use(run_dir: Path) -> dict[str, dict[str, Any]]:
    """The clocks that gave the scene its times: those of stage `sync`, unless geometry replaced some of them.

    Empty where there are none.
    """
    for path in (run_dir / "scene" / "clock_check.json", run_dir / "sync" / "sync.json"):
        if path.is_file():
            return json.loads(path.read_text())["cameras"]
    return {}


def clock_stds(run_dir: Path) -> dict[str, float | None]:
    """Camera -> standard deviation of its clock in use, seconds; None where it is not known. The reference is first."""
    return {name: clock["std_s"] for name, clock in clocks_in_use(run_dir).items()}
