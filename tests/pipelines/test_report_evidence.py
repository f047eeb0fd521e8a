"""Evidence in the report: what calibration measured is shown where it was, and what is missing or odd is left out."""

import json
from pathlib import Path
from typing import Any

import pytest

from devrf.pipelines.report.calibration_section import calibration
from devrf.pipelines.report.curves import clocks
from devrf.pipelines.report.report_page import build_report
from devrf.pipelines.report.run_reader import RunFolder

STAGES = ("ingest", "static_poses", "sync", "rig", "scene", "evaluate")
RESIDUALS = [[10.0, 20.0, 0.1, -0.2], [300.0, 200.0, -0.3, 0.4]]


def board() -> dict[str, Any]:
    """What a board calibration leaves."""
    cells = [[4] * 5 for _ in range(4)] + [[0, 4, 4, 4, 4]]
    return {
        "model": "OPENCV", "terms": "f, cx, cy, k1", "std": {"fx": 1.25}, "rms_px": 0.2, "held_out_rms_px": 0.25,
        "dropped": [[7, 3.5]], "frames": [1, 2, 3], "cells": cells, "tilt_deg": [10.0, 30.0, 45.0],
        "towards_deg": [0.0, 90.0, 200.0], "view_rms_px": [0.2, 0.2, 0.2], "residuals": RESIDUALS,
    }  # fmt: skip


def camera(**details: Any) -> dict[str, Any]:
    """A camera of rig.json."""
    return {
        "model": "OPENCV", "width": 640, "height": 480, "K": [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]],
        "distortion": [0.0] * 5, "std": {"rotation_deg": 0.01, "position": 0.002},
        "intrinsics": "board", "inliers": 60, "rms_px": 0.3, "details": details,
    }  # fmt: skip


def rig() -> dict[str, Any]:
    return {
        "route": "sweep",
        "cameras": {"cam0": camera(board=board(), residuals=RESIDUALS), "c<b>1": camera(), "alone": camera()},
        "graph": [
            {"a": "cam0", "b": "c<b>1", "corners": 40, "points": 0},
            {"a": "cam0", "b": "alone", "corners": 250, "points": 0},
        ],
        "scale": {"metric": True, "source": "board", "factor": 1.0, "std": 0.001},
    }


SYNC = {
    "cameras": {
        "cam0": {"offset_s": 0.0, "method": "reference"},
        "c<b>1": {"offset_s": -0.1, "method": "audio"},
    },
    "loop_s": 0.0005,
}
LAGS = {"lags_s": [-0.2, -0.1, 0.0], "values": [0.0, 1.0, 0.1]}
CURVES = {
    "curves": [
        {"first": "cam0", "second": "c<b>1", "method": "audio", "delay_s": -0.1, "quality": 7.5, **LAGS}
    ],
    "loops": [{"cameras": ["cam0", "c<b>1", "alone"], "cue": "audio", "closure_s": -0.0005}],
    "comparisons": [
        {"first": "cam0", "second": "alone", "cue": "audio", "other": "motion", "difference_s": 0.003}
    ],
}
CHECK = {"pairs": [{"first": "cam0", "second": "alone", "by": "tracks", "sharp": True, **LAGS}]}
POSES = {
    "registered": 50, "given": 50, "mapper": "incremental", "models": [50],
    "attempts": [
        {"name": "incremental", "registered": [50], "mean_reprojection_px": 0.5, "seconds": 20.0},
        {"name": "global", "registered": [48, 2], "mean_reprojection_px": 0.6, "seconds": 5.0},
    ],
    "board": board(), "start": [{"camera_id": 1, "source": "EXIF"}, {"camera_id": 2, "source": "board"}],
    "cameras": {"1": {"width": 64, "height": 48, "K": [[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]},
                "2": {"width": 640, "height": 480, "K": [[510.0, 0, 320], [0, 510, 240], [0, 0, 1]]}},
}  # fmt: skip
HEALTH = {
    "rows": [
        {"code": "camera-bumped", "check": "another", "value": 1.0, "unit": "px"},
        {
            "code": "board-lengths",
            "check": "held-out lengths, error of the median",
            "value": 0.125,
            "unit": "%",
        },
    ]
}


def run_folder(folder: Path, **files: object) -> RunFolder:
    """A run folder with JSON files; `rig` stands for rig/rig.json."""
    names = {"rig": "rig/rig.json", "sync": "sync/sync.json", "curves": "sync/curves.json",
             "check": "scene/clock_check.json", "poses": "static_poses/static_poses.json",
             "metrics": "evaluate/metrics.json", "health": "rig/health.json"}  # fmt: skip
    for key, value in files.items():
        path = folder / names[key]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(value))
    return RunFolder(folder, STAGES, {})


def test_everything_that_was_measured_is_shown(tmp_path: Path) -> None:
    run = run_folder(tmp_path, rig=rig(), poses=POSES, health=HEALTH, metrics={"seed": 7})
    shown = calibration(run)
    ties = {link["names"]: (link["corners"], link["points"], link["verdict"]) for link in shown["links"]}
    assert ties == {
        "cam0 and c<b>1": (40, 0, "fail"),  # ties too little
        "cam0 and alone": (250, 0, "ok"),
        **{f"{name} and sweep": (0, 60, "warn") for name in ("cam0", "c<b>1", "alone")},
    }
    assert [(b["name"], b["most"], b["tilt"]) for b in shown["boards"]] == [
        ("sweep", 4, "10 to 45°, 3 of 8"),
        ("cam0", 4, "10 to 45°, 3 of 8"),
    ]
    assert [c.title for c in shown["left_over"]] == [
        "sweep: board corners",
        "cam0: board corners",
        "cam0: in the rig",
    ]
    assert [n for n, _ in shown["held_out"]] == [1]
    html = build_report(run, "s")
    assert html.count('class="empty"') == 2  # one cell of either board
    assert ">kept<" in html and "48, 2" in html
    assert "<b>1" not in html and "c&lt;b&gt;1" in html
    # boards stand beside the lens in use; the sweep's is the camera that began with the board, of two devices
    assert 'data-key="cameras.2.K.0.0" data-value="510.0"' in html
    assert 'data-key="cameras.cam0.K.0.0" data-value="500.0"' in html
    assert 'data-key="rows.1.value" data-value="0.125"' in html


def test_the_board_route_and_a_lost_sweep_device_leave_out_what_they_lack(tmp_path: Path) -> None:
    lost = {**POSES, "start": [{"camera_id": None, "source": "board"}]}
    shown = calibration(run_folder(tmp_path, rig={**rig(), "route": "board"}, poses=lost))
    assert len(shown["links"]) == 2 and [b["camera"] for b in shown["boards"]] == ["", "cam0"]
    assert len(shown["left_over"]) == 2


def test_clocks_show_pairs_loops_cues_and_geometry(tmp_path: Path) -> None:
    run = run_folder(tmp_path, sync=SYNC, curves=CURVES, check=CHECK)
    shown = clocks(run)
    assert [len(shown[kind]) for kind in ("correlation", "geometry")] == [1, 1]
    html = build_report(run, "s")
    for key, value in (("quality", 7.5), ("delay_s", -0.1)):
        assert f'data-key="curves.0.{key}" data-value="{value}"' in html
    assert 'data-key="loops.0.closure_s" data-value="-0.0005"' in html
    assert 'data-key="comparisons.0.difference_s"' in html and "cam0 → c&lt;b&gt;1 → alone" in html
    assert "cameras.cam0.offset_s" not in html and 'data-key="cameras.c&lt;b&gt;1.offset_s"' in html


@pytest.mark.parametrize(
    "odd",
    [
        {"details": {"board": {"cells": "x", "tilt_deg": [None], "residuals": [[1, 2]], "dropped": None}}},
        {"details": {"board": 3, "residuals": []}},
        {"details": None, "std": None, "inliers": None, "width": None},
        {"details": {"residuals": [[1, 2, None, 4]]}, "std": {}, "K": None},
    ],
)
def test_odd_values_and_older_runs_leave_out_what_they_lack(odd: dict[str, Any], tmp_path: Path) -> None:
    value = rig()
    value["cameras"]["cam0"] |= odd
    value["graph"] += [{"a": "cam0"}, {"a": "cam0", "b": "nobody", "corners": 3, "points": 4}, 5]
    run = run_folder(tmp_path, rig=value, poses={"attempts": [{}]})
    html = build_report(run, "s")
    assert "cannot be made" not in html and "nan" not in html.lower() and not calibration(run)["left_over"]
