"""Tables of tests/formats: what files of other programs say, and what is to come of it."""

from pathlib import Path
from typing import Any

import yaml


def table(name: str) -> dict[str, Any]:
    """Its rows, by what is to be done with them."""
    return yaml.safe_load((Path(__file__).parents[1] / "formats" / f"{name}.yaml").read_text())
