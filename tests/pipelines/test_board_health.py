"""What a field crew is told about a board: each failure by its own row, and nothing about a healthy capture."""

from dataclasses import replace

import numpy as np
import pytest

from devrf.calibration.boards.calibrate import BoardCalibration, calibrate_intrinsics
from devrf.calibration.boards.simulated import LENS, SIZE, SPEC, board_views, camera
from devrf.calibration.boards.spec import BoardView
from devrf.pipelines.health.board import board_rows
from devrf.pipelines.health.rows import HealthRow


def calibrated(views: list[BoardView], spec=SPEC) -> BoardCalibration:
    return calibrate_intrinsics("cam1", views, spec, SIZE, lens="pinhole")


def fired(board: BoardCalibration) -> dict[str, HealthRow]:
    """Rows that are not fine, by name."""
    return {r.check: r for r in board_rows("cam1", board) if r.verdict != "ok"}


def test_a_healthy_capture_fires_none():
    assert fired(calibrated(board_views(24, 0.2))) == {}


def test_wrong_layout_is_named():
    """C1 and C2: what to write into scene.yaml."""
    found = replace(
        SPEC, legacy=True, inverted=False, corrections=(("squares", "[8, 6]"), ("legacy", "true"))
    )
    rows = fired(calibrated(board_views(24, 0.2), found))
    assert list(rows) == ["board before cam1"]
    assert rows["board before cam1"].value == "8x6 charuco with DICT_5X5_100, legacy layout"
    assert "write squares: [8, 6], legacy: true in capture.board" in rows["board before cam1"].remedy
    as_told = replace(SPEC, legacy=True, inverted=True)  # found out, where `auto` was told: said, and fine
    rows = {r.check: r for r in board_rows("cam1", calibrated(board_views(24, 0.2), as_told))}
    assert rows["board before cam1"].verdict == "ok"
    assert str(rows["board before cam1"].value).endswith("legacy layout, white on black")


def test_a_bent_board_is_named():
    """C4: 2 mm over 36 cm."""
    rows = fired(calibrated(board_views(24, 0.2, bow_m=0.002)))
    assert list(rows) == ["bow of the board before cam1"]
    assert "bows by 2.0" in rows["bow of the board before cam1"].remedy
    assert "rigid, flat plate" in rows["bow of the board before cam1"].remedy


def test_few_views_are_named():
    """C5: with how unsure the principal point is."""
    rows = fired(calibrated(board_views(8, 0.3, seed=1)))
    assert "board views of cam1" in rows
    board = calibrated(board_views(8, 0.3, seed=1))
    assert board.intrinsics.std is not None
    doubt = max(board.intrinsics.std[2:4])
    assert f"(+- {doubt:.1f} px): film the board longer" in rows["board views of cam1"].remedy


def test_frontal_views_are_named():
    """C6: and the focal length says that it is unsure."""
    rows = fired(calibrated(board_views(20, 0.3, tilt_deg=(0.0, 4.0), share=(0.4, 0.5))))
    assert (
        "tilt the board by 20 to 45 degrees"
        in rows["directions in which the board was tilted before cam1"].remedy
    )
    assert "focal length of cam1 by the board, standard deviation" in rows


def test_empty_corners_are_named():
    """C7."""
    rows = fired(calibrated(board_views(20, 0.2, place=(0.2, 0.4), share=(0.25, 0.35))))
    remedy = rows["picture covered by board corners, cam1"].remedy
    assert (
        "every corner of the picture" in remedy and "bottom-right corner" in remedy and "right edge" in remedy
    )


def test_blurred_views_are_named():
    """C8."""
    views = [
        replace(v, blur=0.3 if n % 3 == 0 else 0.05, blur_px=9.0) for n, v in enumerate(board_views(24, 0.2))
    ]
    rows = fired(calibrated(views))
    assert list(rows) == ["board views of cam1 left out"]
    assert rows["board views of cam1 left out"].remedy.startswith("8 of 24 views of the board are blurred")
    assert str(rows["board views of cam1 left out"].value).startswith("blurred 0, 3, 6, 9, 12, 15 and 2 more")


def test_a_local_minimum_is_said():
    """C9: which start was better; nothing to do about it."""
    board = replace(calibrated(board_views(24, 0.2)), start_rms_px=(0.70, 0.41))
    rows = {r.check: r for r in board_rows("cam1", board)}
    assert "second start better: 0.41 against 0.70 px" in str(rows["lens of cam1 by the board"].value)
    assert rows["lens of cam1 by the board"].verdict == "ok"


def test_unsupported_coefficients_are_said():
    """C11: a lens with k1 alone."""
    views = board_views(24, 0.2, lens=camera(lens=(-0.1, 0.0, 0.0, 0.0, 0.0)))
    rows = {r.check: r for r in board_rows("cam1", calibrated(views))}
    said = str(rows["lens of cam1 by the board"].value)
    assert said.startswith("k1; not supported by the views: k2 ") and "+-" in said


def test_misread_views_are_named():
    """C12: with their errors."""
    views = board_views(24, 0.1)
    for n in (17, 20):
        views[n] = replace(views[n], xy=np.roll(views[n].xy, 3, axis=0))
    rows = fired(calibrated(views))
    assert list(rows) == ["board views of cam1 left out"]
    assert "misread" in rows["board views of cam1 left out"].remedy
    said = str(rows["board views of cam1 left out"].value)
    assert said.startswith("do not fit 17 (") and ", 20 (" in said and "px)" in said


@pytest.mark.parametrize(("noise_px", "verdict"), [(1.2, "warn"), (4.0, "fail")])
def test_a_board_that_does_not_fit_is_named(noise_px, verdict):
    rows = fired(calibrated(board_views(24, noise_px)))
    assert rows["board error of cam1"].verdict == verdict
    assert "check squares" in rows["board error of cam1"].remedy


def test_views_that_agree_less_than_the_fitted_ones_are_named():
    board = replace(calibrated(board_views(24, 0.2)), held_out_rms_px=1.4)
    rows = fired(board)
    assert list(rows) == ["board error of cam1 on views held out"]
    assert "focus and zoom locked" in rows["board error of cam1 on views held out"].remedy


def test_fisheyes_are_said():
    views = board_views(
        14, 0.2, lens=camera(450.0, (0.01, 0.0, 0.0, 0.0, 0.0), "OPENCV_FISHEYE"), share=(0.3, 0.6)
    )
    board = calibrate_intrinsics("cam1", views, SPEC, SIZE, lens="fisheye")
    rows = {r.check: r for r in board_rows("cam1", board)}
    assert str(rows["lens of cam1 by the board"].value).startswith("fisheye k1")
    assert LENS[0] < 0 < board.intrinsics.distortion[0]
