"""The page of evidence: what calibration measured is drawn where it was, and what is missing or odd is left out."""

import json
import re
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devrf.pipelines.report.calibration import rig_section
from devrf.pipelines.report.clocks import sync_section
from devrf.pipelines.report.evidence import evidence_section
from devrf.pipelines.report.plots import arrows, cell_grid, cloud, ellipses, link_graph, nice, rose
from devrf.pipelines.report.run import RunFolder

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


def camera(x: float, **details: Any) -> dict[str, Any]:
    """A camera of rig.json that looks along z from (x, 0, -x / 2)."""
    pose = [[1.0, 0, 0, -x], [0, 1.0, 0, 0], [0, 0, 1.0, x / 2]]
    return {
        "model": "OPENCV", "width": 640, "height": 480, "K": [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]],
        "distortion": [0.0] * 5, "cam_from_world": pose, "std": {"rotation_deg": 0.01, "position": 0.002},
        "intrinsics": "board", "inliers": 60, "rms_px": 0.3, "details": details,
    }  # fmt: skip


def rig() -> dict[str, Any]:
    covariance = [[1e-6, 0, 0], [0, 1e-6, 0], [0, 0, 9e-6]]
    return {
        "route": "sweep",
        "cameras": {
            "cam0": camera(0.0, board=board(), position_covariance=covariance, residuals=RESIDUALS),
            "c<b>1": camera(1.0, axis_std=3e-3, sideways_std=1e-3),
            "alone": camera(2.0),
        },
        "graph": [
            {"a": "cam0", "b": "c<b>1", "corners": 40, "points": 0},
            {"a": "cam0", "b": "alone", "corners": 0, "points": 0},
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
CURVES = {
    "curves": [
        {"first": "cam0", "second": "c<b>1", "method": "audio", "delay_s": -0.1, "quality": 7.5, "accepted": True,
         "lags_s": [-0.2, -0.1, 0.0], "values": [0.0, 1.0, 0.1]},
    ],
    "loops": [{"cameras": ["cam0", "c<b>1", "alone"], "cue": "audio", "closure_s": -0.0005}],
    "comparisons": [{"first": "cam0", "second": "alone", "cue": "audio", "other": "motion", "difference_s": 0.003,
                     "limit_s": 0.01, "contradicts": False}],
}  # fmt: skip
CHECK = {
    "pairs": [
        {"first": "cam0", "second": "alone", "by": "tracks", "offset_s": 0.0, "std_s": 1e-3, "sharp": True,
         "lags_s": [-0.02, 0.0, 0.02], "values": [3.0, 1.0, 3.0]}
    ]
}  # fmt: skip
POSES = {
    "registered": 50, "given": 50, "mapper": "incremental", "models": [50],
    "attempts": [
        {"name": "incremental", "registered": [50], "mean_reprojection_px": 0.5, "seconds": 20.0},
        {"name": "global", "registered": [48, 2], "mean_reprojection_px": 0.6, "seconds": 5.0},
    ],
    "compared": [{"name": "global", "against": "incremental", "apart_deg": {"a.jpg": 0.04, "b.jpg": 0.11}}],
    "board": board(), "start": [{"camera_id": 1, "source": "EXIF"}, {"camera_id": 2, "source": "board"}],
    "cameras": {"1": {"width": 64, "height": 48, "K": [[40.0, 0, 32], [0, 40, 24], [0, 0, 1]]},
                "2": {"width": 640, "height": 480, "K": [[510.0, 0, 320], [0, 510, 240], [0, 0, 1]]}},
}  # fmt: skip


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


def test_everything_that_was_measured_is_drawn(tmp_path: Path) -> None:
    html = evidence_section(run_folder(tmp_path, rig=rig(), poses=POSES, metrics={"seed": 7}))
    for heading in (
        "Boards",
        "What ties the cameras",
        "How sure the positions are",
        "What is left over",
        "Mappers",
    ):
        assert f"<h3>{heading}</h3>" in html
    for title in ("sweep: corners seen", "cam0: corners seen", "cam0: tilt of the board", "cam0: in the rig",
                  "sweep: board corners", "From above", "From the side"):  # fmt: skip
        assert title in html
    assert html.count('class="cell empty"') == 2  # one cell of either board
    assert html.count('class="ellipse"') == 0 and html.count('class="sigma"') == 2 * 3
    assert 'class="link fail"' in html  # 40 corners tie too little
    assert html.count('class="link warn"') == 3  # 60 points of the sweep each
    assert "0.11° apart" in html and ">kept<" in html and "48, 2" in html
    assert "<b>1" not in html and "c&lt;b&gt;1" in html
    assert "Seed of every random draw" in html


def test_boards_stand_beside_the_lens_in_use(tmp_path: Path) -> None:
    """The sweep's is the camera that began with the board, of two devices; it may not be in the model."""
    html = evidence_section(run_folder(tmp_path, rig=rig(), poses=POSES))
    assert 'data-key="cameras.2.K.0.0" data-value="510.0"' in html
    assert 'data-key="cameras.cam0.K.0.0" data-value="500.0"' in html
    lost = {**POSES, "start": [{"camera_id": 1, "source": "EXIF"}, {"camera_id": None, "source": "board"}]}
    html = evidence_section(run_folder(tmp_path / "lost", poses=lost))
    assert "<h3>Boards</h3>" in html and "K.0.0" not in html


def test_the_reference_clock_is_said_to_be_it(tmp_path: Path) -> None:
    html = sync_section(run_folder(tmp_path, sync=SYNC))
    assert "the reference" in html and "cameras.cam0.offset_s" not in html
    assert 'data-key="cameras.c&lt;b&gt;1.offset_s"' in html


def test_millimetres_are_those_of_the_rig_stage(tmp_path: Path) -> None:
    check = "held-out lengths on the board"
    rows = [
        {"check": "another", "value": 1.0, "unit": "px"},
        {"check": f"{check}, error of the median", "value": 0.125, "unit": "%"},
        {"check": check, "value": "54.02 +- 0.38 mm (true 54.00)", "unit": ""},
    ]
    html = evidence_section(run_folder(tmp_path, rig=rig(), health={"rows": rows}))
    assert 'data-key="rows.1.value" data-value="0.125"' in html and "54.02 +- 0.38 mm" in html
    assert "error of the median" in html and "another" not in html


def test_board_route_shows_who_hangs_loose(tmp_path: Path) -> None:
    html = evidence_section(run_folder(tmp_path, rig={**rig(), "route": "board"}))
    assert (
        html.count('class="node alone"') == 1
        and "pts" not in html.split("<h3>How sure")[0].split("</svg>")[-2]
    )


def test_clocks_show_pairs_loops_cues_and_geometry(tmp_path: Path) -> None:
    html = sync_section(run_folder(tmp_path, sync=SYNC, curves=CURVES, check=CHECK))
    words = re.sub(r"<[^>]+>", " ", html)
    for word in (
        "peak over next",
        "cam0 → c&lt;b&gt;1 → alone",
        "motion against audio",
        "agree",
        "By geometry",
    ):
        assert word in words
    assert 'data-key="curves.0.quality" data-value="7.5"' in html
    assert 'data-key="loops.0.closure_s" data-value="-0.0005"' in html


@pytest.mark.parametrize("make", [evidence_section, sync_section, rig_section])
def test_nothing_is_made_of_nothing(make: Any, tmp_path: Path) -> None:
    assert 'class="absent"' in make(run_folder(tmp_path))


def test_an_older_run_leaves_out_what_it_did_not_measure(tmp_path: Path) -> None:
    old = {
        "cameras": {"cam0": {**camera(0.0), "details": {}}, "cam1": camera(1.0)},
        "scale": {"metric": False},
    }
    html = evidence_section(run_folder(tmp_path, rig=old, sync=SYNC, curves={"curves": CURVES["curves"]}))
    assert "What ties the cameras" in html and "How sure the positions are" in html
    assert "Boards" not in html and "What is left over" not in html and "Mappers" not in html


@pytest.mark.parametrize(
    "odd",
    [
        {"details": {"board": {"cells": "x", "tilt_deg": [None], "residuals": [[1, 2]], "dropped": None}}},
        {"details": {"board": 3, "residuals": [], "position_covariance": [[1, 2, 3]]}},
        {"details": None, "std": None, "inliers": None, "cam_from_world": None, "width": None},
        {"details": {"residuals": [[1, 2, None, 4]], "position_covariance": [[None] * 3] * 3}, "std": {}},
    ],
)
def test_odd_values_are_left_out(odd: dict[str, Any], tmp_path: Path) -> None:
    value = rig()
    value["cameras"]["cam0"] |= odd
    value["graph"] += [{"a": "cam0"}, {"a": "cam0", "b": "nobody", "corners": 3, "points": 4}, 5]
    html = evidence_section(run_folder(tmp_path, rig=value, poses={"attempts": [{}], "compared": 3}))
    assert 'id="evidence"' in html and "nan" not in html.lower().replace("nance", "")


# --- drawings ---


def numbers(pattern: str, html: str) -> np.ndarray:
    return np.array([[float(v) for v in found] for found in re.findall(pattern, html)])


def test_a_cloud_is_true_to_scale() -> None:
    """The ring at 2 px has twice the radius of the one at 1 px, and a dot at (1, 0) lies on that one."""
    dxy = np.array([[1.0, 0.0], [0.0, 1.6], [-1.6, 0.0]])
    html = cloud(dxy, "cam0")
    rings = numbers(r'class="ring" cx="([\d.]+)" cy="([\d.]+)" r="([\d.]+)"', html)
    assert rings[1, 2] == pytest.approx(2 * rings[0, 2]) and ">2 px<" in html
    spots = numbers(r"M([\d.]+) ([\d.]+)h0", html)
    np.testing.assert_allclose(
        spots[0] - rings[0, :2], [rings[0, 2], 0.0], atol=0.06
    )  # one decimal is written
    assert spots[1][1] > rings[0, 1]  # y down, as in the picture


def test_arrows_start_where_they_were_measured() -> None:
    html = arrows(np.array([[320.0, 240.0]]), np.array([[0.0, 2.0]]), (640, 480), "cam0")
    (x1, y1, x2, y2) = numbers(r"M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)", html)[0]
    width, height = numbers(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', html)[0]
    assert (x1, y1) == pytest.approx((width / 2, height / 2), abs=0.06)
    assert x2 == x1 and y2 > y1 and "10 times larger" in html  # 2 px drawn as 20: under 5 % of the width


def test_an_ellipse_lies_along_its_doubt() -> None:
    """Longest along (1, 1), which is up to the right: minus 45 degrees in SVG's clockwise turn."""
    long = np.array([[1.0, 1.0], [1.0, 1.0]]) * 4.5e-6 + np.eye(2) * 1e-6
    centres, looks = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 1.0]])
    html = ellipses(centres, np.array([long, np.eye(2) * 1e-6]), ["a", "b"], looks, "m", "From above")
    radii = numbers(r'rx="([\d.]+)" ry="([\d.]+)" transform="rotate\((-?[\d.]+)', html)
    assert radii[0, 0] / radii[0, 1] == pytest.approx(np.sqrt(10), rel=0.02)
    assert radii[0, 2] % 180 == pytest.approx(135)
    y1, y2 = numbers(r'class="look" x1="[\d.]+" y1="([\d.]+)" x2="[\d.]+" y2="([\d.]+)"', html)[0]
    assert y2 < y1  # looks along +y, which is up in a plan


def test_a_rose_has_its_directions_as_the_picture() -> None:
    spots = numbers(r"M([\d.]+) ([\d.]+)h0", rose([0.0, 90.0], [30.0, 30.0], 60.0, "°", "t"))
    assert spots[0, 0] > spots[1, 0] and spots[1, 1] > spots[0, 1]  # right; down


def test_empty_drawings_are_no_text() -> None:
    none = np.zeros((0, 2))
    assert cloud(none, "t") == arrows(none, none, (1, 1), "t") == rose([], [], 1.0, "", "t") == ""
    assert cell_grid([], "t") == ellipses(none, np.zeros((0, 2, 2)), [], none, "m", "t") == ""
    assert "node alone" in link_graph(["a", "b"], [], "sweep")


def test_words_of_crossing_links_do_not_cover_each_other() -> None:
    """Four cameras and the sweep, each tied to each: two links cross in the middle, where the sweep stands."""
    cameras = [f"cam{n}" for n in range(4)]
    links = [(a, b, "12 + 340 pts", "ok") for a, b in combinations([*cameras, "sweep"], 2)]
    places = numbers(r'class="linkword ok" x="([\d.]+)" y="([\d.]+)"', link_graph(cameras, links, "sweep"))
    assert len(places) == len(links)
    width, height = (
        len(links[0][2]) * 6.0,
        12.0,
    )  # drawn 12 px high; digits are half as wide, other letters less
    apart = np.abs(places[:, None] - places)[np.triu_indices(len(places), 1)]
    assert (apart >= [width, height]).any(axis=1).all()


@pytest.mark.parametrize(
    ("value", "down", "up"), [(0.3, 0.2, 0.5), (7.0, 5.0, 10.0), (2.0, 2.0, 2.0), (0.0, 1.0, 1.0)]
)
def test_nice_numbers(value: float, down: float, up: float) -> None:
    assert (nice(value), nice(value, up=True)) == pytest.approx((down, up))
