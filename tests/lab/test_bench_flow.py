"""`bench flow` through the command line: rows with goals where data is, reasons where it is not."""

import json
from pathlib import Path


def rows_of(devrf, data: Path, out: Path, only: str) -> dict[str, dict]:
    done = devrf("bench", "flow", "--data", data, "--out", out, "--only", only)
    assert done.code == 0, done.said
    return {row["name"]: row for row in json.loads((out / "flow.json").read_text())["rows"]}


def test_without_data_it_says_why(devrf, tmp_path: Path) -> None:
    rows = rows_of(devrf, tmp_path, tmp_path / "out", "accuracy,speed,store")
    assert len(rows) == 3
    assert all(row["value"] is None and "middlebury_flow is not in" in row["why"] for row in rows.values())


def test_without_weights_only_dis_is_measured(devrf, data_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "middlebury_flow").symlink_to(data_dir / "middlebury_flow")
    rows = rows_of(devrf, tmp_path, tmp_path / "out", "accuracy,store")
    raft = rows["flow/Venus/raft small/end-point error"]
    assert raft["value"] is None and "weights/raft-small.pth" in raft["why"]
    dis = rows["flow/Venus/dis medium/end-point error"]
    assert dis["met"] and 0.1 < dis["value"] <= dis["goal"] == 0.40
    stored = rows["flow/RubberWhale/dis medium/on disk"]
    assert stored["met"] and 0.1 < stored["value"] <= stored["goal"] == 2.5
