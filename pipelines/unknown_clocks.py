"""Clocks of test cameras that are not known well enough to measure by, and what the model says of them."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from devrf.capture.durable import read_object

Clocks = Mapping[str, Mapping[str, Any]]
"""By camera `std_s` as calibrated, and `offset_s`, or None and `why`: `test_clocks` of stage `deformation`."""


def unknown_clocks(run_dir: Path) -> Clocks:
    """Those of a run; none where its motion is not trained."""
    return read_object(run_dir / "deformation" / "metrics.json").get("test_clocks", {})


def unknown_clock_notes(clocks: Clocks, shown: Iterable[str]) -> list[str]:
    """By which clock test cameras are shown, where theirs is not known."""
    notes = []
    for name in shown:
        if name in clocks:
            offset_s, why = clocks[name].get("offset_s"), clocks[name].get("why")
            said = (
                why if offset_s is None else f"by what moves its pictures are {1e3 * offset_s:+.0f} ms later"
            )
            notes.append(
                f"{name} is shown by its clock as it was calibrated, which is not known well ({said})"
            )
    return notes
