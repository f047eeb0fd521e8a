"""Read the clocks that stage `sync` wrote."""

import json
from pathlib import Path


def read_clocks(path: Path) -> dict[str, tuple[float, float]]:
    """Camera -> (offset_s, rate): true time = offset_s + rate * file time, on the first camera's clock.

    Clips that only show the board have clocks of their own, under their own names. Empty without the file.
    """
    if not path.is_file():
        return {}
    content = json.loads(path.read_text())
    clocks = {**content.get("joint", {}).get("cameras", {}), **content["cameras"]}
    return {name: (c["offset_s"], 1 + 1e-6 * c["drift_ppm"]) for name, c in clocks.items()}
