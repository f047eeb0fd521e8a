"""What a field crew is told about a board: each failure by its own row, and nothing about a healthy capture.

How the faults are measured is tested in tests/calibration/test_board_intrinsics.py; here a healthy calibration is
given what a faulty capture measures.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devrf.calibration.boards.calibrate import BoardCalibration, calibrate_intrinsics
from devrf.lab.bench.accuracy.simulated_boards import SIZE, SPEC, board_views
from devrf.pipelines.health.board_rows import board_measures, fits
from devrf.pipelines.health.judge import HealthRow, judge


@pytest.fixture(scope="module")
def healthy() -> BoardCalibration:
    return calibrate_intrinsics("cam1", board_views(24, 0.2), SPEC, SIZE, lens="pinhole")


def rows_of(board: BoardCalibration) -> dict[str, HealthRow]:
    """Rows that are not fine, by code."""
    return {row.code: row for row in judge(board_measures("cam1", board)) if row.verdict != "ok"}


def test_a_healthy_capture_fires_none(healthy: BoardCalibration) -> None:
    assert rows_of(healthy) == {}


LAYOUT = replace(SPEC, legacy=True, corrections=(("squares", "[8, 6]"), ("legacy", "true")))
BLURRED = tuple(range(0, 24, 3))


@pytest.mark.parametrize(
    ("changes", "evidence", "code", "named"),
    [
        # C1, C2: what to write into scene.yaml; C4: 2 mm over 36 cm; C5; C6; C7; C8; C12
        ({"board": LAYOUT}, {}, "board-corrected", "squares: [8, 6], legacy: true in capture.board"),
        ({"bow_mm": (2.0, 0.0)}, {}, "board-bow", "2.0"),
        ({"views": 8}, {}, "board-views", ""),
        ({}, {"tilt_deg": np.full(24, 3.0)}, "board-tilt", "20 to 45"),
        (
            {},
            {"cells": np.pad(np.full((3, 3), 9), (0, 2))},
            "board-coverage",
            "top-right corner, bottom-left corner, ",
        ),
        ({"views": 16, "blurred": BLURRED}, {}, "board-views", "8 of 24"),
        ({"dropped": {17: 30.5, 20: 41.2}}, {}, "board-views", "misread"),
        ({"rms_px": 1.2}, {}, "board-error", "square"),
    ],
)
def test_a_fault_is_named_by_one_row(
    healthy: BoardCalibration, changes: dict[str, Any], evidence: dict[str, Any], code: str, named: str
) -> None:
    found = rows_of(replace(healthy, evidence=replace(healthy.evidence, **evidence), **changes))
    assert list(found) == [code] and found[code].verdict == "warn" and found[code].about == "cam1"
    assert found[code].remedy and named in found[code].remedy


def test_corners_of_the_picture_count_where_most_of_it_is_covered(healthy: BoardCalibration) -> None:
    cells = np.full((5, 5), 9)
    cells[[0, 0, 4], [0, 4, 0]] = 0
    found = rows_of(replace(healthy, evidence=replace(healthy.evidence, cells=cells)))
    assert list(found) == ["board-coverage"] and "top-left corner" in found["board-coverage"].remedy
    cells[0, 0] = 9
    assert rows_of(replace(healthy, evidence=replace(healthy.evidence, cells=cells))) == {}


def test_a_board_that_fits_far_worse_is_not_used(healthy: BoardCalibration) -> None:
    row = rows_of(replace(healthy, rms_px=4.0))["board-error"]
    assert row.verdict == "warn" and "not used" in row.remedy
    assert fits(healthy) and not fits(replace(healthy, rms_px=4.0))


def test_views_that_are_left_out_are_named(healthy: BoardCalibration) -> None:
    row = rows_of(replace(healthy, blurred=BLURRED, dropped={17: 30.5, 20: 41.2}))["board-views"]
    assert "0, 3, 6, 9, 12, 15 and 2 more" in str(row.value) and "17 (30.5 px), 20 (41.2 px)" in str(
        row.value
    )
