"""The clocks that gave the scene its times, and what geometry says of two of them."""

import json
from pathlib import Path
from typing import Any

from devrf.calibration.clocks.equations import Equation
from devrf.pipelines.clocks import read_sync


def clocks_in_use(run_dir: Path) -> dict[str, dict[str, Any]]:
    """The clocks that gave the scene its times: those of stage `sync`, unless geometry replaced some of them.

    Empty where there are none.
    """
    for path in (run_dir / "scene" / "clock_check.json", run_dir / "sync" / "sync.json"):
        if path.is_file():
            return json.loads(path.read_text())["cameras"]
    return {}


def sharp_pairs(run_dir: Path) -> list[Equation]:
    """What geometry says of two clocks in use, where it is sharp and agrees with other pairs.

    By how much more the second one is to be raised; empty where geometry was not asked.
    """
    path = run_dir / "scene" / "clock_check.json"
    content = json.loads(path.read_text()) if path.is_file() else {}
    if "pairs" not in content:
        return []
    before, used = read_sync(run_dir), content["cameras"]
    raised_s = {name: clock["offset_s"] - before[name].offset_s for name, clock in used.items()}
    return [
        Equation(
            p["first"],
            p["second"],
            p["offset_s"] - raised_s[p["second"]] + raised_s[p["first"]],
            0.0,
            p["std_s"],
            "geometry",
            1.0,
        )
        for p in content["pairs"]
        if p["sharp"] and not p.get("dropped")
    ]
