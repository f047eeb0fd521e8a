"""What a field crew is told about a board: each failure by its own row, and nothing about a healthy capture.

How the faults are measured is tested in tests/calibration/test_board_intrinsics.py; here a healthy calibration is
given what a faulty capture measures.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from devrf.calibration.boards.calibrate import BoardCalibration, calibrate_intrinsics
from devrf.lab.bench.accuracy.simulated_boards import SIZE, SPEC, board_views, camera
from devrf.pipelines.health.board import board_rows
from devrf.pipelines.health.rows import HealthRow


@pytest.fixture(scope="module")
def healthy() -> BoardCalibration:
    return calibrate_intrinsics("cam1", board_views(24, 0.2), SPEC, SIZE, lens="pinhole")


def rows_of(board: BoardCalibration) -> dict[str, HealthRow]:
    return {row.check: row for row in board_rows("cam1", board)}


def fired(board: BoardCalibration) -> dict[str, HealthRow]:
    """Rows that are not fine, by name."""
    return {check: row for check, row in rows_of(board).items() if row.verdict != "ok"}


def test_a_healthy_capture_fires_none(healthy: BoardCalibration) -> None:
    assert fired(healthy) == {}


LAYOUT = replace(SPEC, legacy=True, corrections=(("squares", "[8, 6]"), ("legacy", "true")))
BLURRED = tuple(range(0, 24, 3))


@pytest.mark.parametrize(
    ("changes", "evidence", "check", "named"),
    [
        # C1, C2: what to write into scene.yaml; C4: 2 mm over 36 cm; C5; C6; C7; C8; C12; C9
        ({"board": LAYOUT}, {}, "board before cam1", "squares: [8, 6], legacy: true in capture.board"),
        ({"bow_mm": (2.0, 0.0)}, {}, "bow of the board before cam1", "2.0"),
        ({"views": 8}, {}, "board views of cam1", ""),
        (
            {},
            {"tilt_deg": np.full(24, 3.0)},
            "directions in which the board was tilted before cam1",
            "20 to 45",
        ),
        (
            {},
            {"cells": np.pad(np.full((3, 3), 9), (0, 2))},
            "picture covered by board corners, cam1",
            "top-right corner, bottom-left corner, bottom-right corner, ",
        ),
        ({"views": 16, "blurred": BLURRED}, {}, "board views of cam1 left out", "8 of 24"),
        ({"dropped": {17: 30.5, 20: 41.2}}, {}, "board views of cam1 left out", "misread"),
        ({"rms_px": 1.2}, {}, "board error of cam1", "square"),
        ({"held_out_rms_px": 1.4}, {}, "board error of cam1 on views held out", ""),
    ],
)
def test_a_fault_is_named_by_one_row(
    healthy: BoardCalibration, changes: dict[str, Any], evidence: dict[str, Any], check: str, named: str
) -> None:
    found = fired(replace(healthy, evidence=replace(healthy.evidence, **evidence), **changes))
    assert list(found) == [check] and found[check].verdict == "warn"
    assert found[check].remedy and named in found[check].remedy


def test_a_board_that_fits_far_worse_is_refused(healthy: BoardCalibration) -> None:
    assert fired(replace(healthy, rms_px=4.0))["board error of cam1"].verdict == "fail"


def test_an_unsure_focal_length_is_named(healthy: BoardCalibration) -> None:
    assert healthy.intrinsics.std is not None
    unsure = replace(healthy.intrinsics, std=100 * healthy.intrinsics.std)
    assert "focal length of cam1 by the board, standard deviation" in fired(
        replace(healthy, intrinsics=unsure)
    )


def test_what_was_found_and_left_out_is_said(healthy: BoardCalibration) -> None:
    said = rows_of(
        replace(healthy, board=replace(SPEC, legacy=True, inverted=True), start_rms_px=(0.70, 0.41))
    )
    assert all(
        word in str(said["board before cam1"].value) for word in ("8x6 charuco", "DICT_5X5_100", "legacy")
    )
    assert said["board before cam1"].verdict == said["lens of cam1 by the board"].verdict == "ok"
    assert "0.41 against 0.70 px" in str(said["lens of cam1 by the board"].value)
    left_out = rows_of(replace(healthy, blurred=BLURRED, dropped={17: 30.5, 20: 41.2}))
    value = str(left_out["board views of cam1 left out"].value)
    assert "0, 3, 6, 9, 12, 15 and 2 more" in value and "17 (30.5 px), 20 (41.2 px)" in value
    few = rows_of(replace(healthy, unsupported="k2 -0.012 +- 0.030"))
    assert str(few["lens of cam1 by the board"].value).endswith("k2 -0.012 +- 0.030")


def test_fisheyes_are_said() -> None:
    views = board_views(
        14, 0.2, lens=camera(450.0, (0.01, 0.0, 0.0, 0.0, 0.0), "OPENCV_FISHEYE"), share=(0.3, 0.6)
    )
    board = calibrate_intrinsics("cam1", views, SPEC, SIZE, lens="fisheye")
    assert str(rows_of(board)["lens of cam1 by the board"].value).startswith("fisheye k1")
