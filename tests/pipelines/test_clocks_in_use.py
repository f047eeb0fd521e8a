"""What geometry says of two clocks, from what stages `sync` and `scene` left."""

import json
from pathlib import Path
from typing import Any

import pytest

from devrf.pipelines.clocks_in_use import clocks_in_use, sharp_pairs


def clock(offset_s: float, method: str) -> dict[str, Any]:
    return {
        "offset_s": offset_s,
        "drift_ppm": 0.0,
        "std_s": 0.01,
        "method": method,
        "confidence": 0.9,
        "basis": "",
    }


def pair(first: str, second: str, **changes: Any) -> dict[str, Any]:
    return {
        "first": first,
        "second": second,
        "offset_s": 0.03,
        "std_s": 0.002,
        "sharp": True,
        "dropped": False,
    } | changes


def written(run_dir: Path, name: str, content: dict[str, Any]) -> None:
    (run_dir / name).parent.mkdir(exist_ok=True)
    (run_dir / name).write_text(json.dumps(content))


def test_pairs_are_what_is_left_to_the_clocks_in_use(tmp_path: Path) -> None:
    before = {name: clock(0.0, "motion") for name in ("a", "b", "witness")}
    used = before | {"b": clock(0.02, "geometry")}
    pairs = [
        pair("a", "b"),
        pair("b", "witness"),
        pair("a", "witness", sharp=False),
        pair("a", "witness", dropped=True),
    ]
    written(tmp_path, "sync/sync.json", {"cameras": before})
    assert clocks_in_use(tmp_path) == before and sharp_pairs(tmp_path) == []
    written(tmp_path, "scene/clock_check.json", {"cameras": used, "pairs": pairs})
    assert clocks_in_use(tmp_path) == used
    left = [(p.a, p.b, p.delay_s) for p in sharp_pairs(tmp_path)]
    assert left == [("a", "b", pytest.approx(0.01)), ("b", "witness", pytest.approx(0.05))]
