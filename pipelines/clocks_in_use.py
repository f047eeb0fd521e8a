"""The clocks that gave the scene its times."""

import json
from pathlib import Path
from typing import Any


def clocks_in_use(run_dir: Path) -> dict[str, dict[str, Any]]:
    """The clocks that gave the scene its times: those of stage `sync`, unless geometry replaced some of them.

    Empty where there are none.
    """
    for path in (run_dir / "scene" / "clock_check.json", run_dir / "sync" / "sync.json"):
        if path.is_file():
            return json.loads(path.read_text())["cameras"]
    return {}
