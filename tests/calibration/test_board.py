"""Boards rendered with known places, in every way they are printed; intrinsics from exact and noisy views."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from devrf.calibration.board import BoardSpec, BoardView, find_board
from devrf.calibration.board_intrinsics import calibrate_intrinsics, coverage
from devrf.calibration.board_layout import settle
from devrf.capture.camera import Camera
from devrf.capture.errors import HealthError, InputError

SPEC = BoardSpec("charuco", (6, 4), 0.05, 0.0375, "DICT_5X5_100")
PIXELS_PER_SQUARE = 60
SIZE = (640, 480)
K = np.array([[520.0, 0, 322.0], [0, 520.0, 237.0], [0, 0, 1]])
K1 = -0.08


def board_pose(rng: np.random.Generator, spec: BoardSpec, distance: float = 0.5) -> np.ndarray:
    """cam_from_board [3, 4]: the board tilted by up to 35 degrees somewhere in the picture."""
    R = cv2.Rodrigues(rng.uniform(-0.6, 0.6, 3))[0]
    centre = np.array([*(spec.corners[:, :2].mean(0)), 0.0])
    place = np.array([*rng.uniform(-0.1, 0.1, 2), distance * rng.uniform(0.8, 1.3)])
    return np.column_stack([R, place - R @ centre])


def draw(
    spec: BoardSpec, cam_from_board: np.ndarray, legacy: bool = False, inverted: bool = False
) -> np.ndarray:
    """A picture of the flat print, with a lens without distortion."""
    if spec.type == "charuco":
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
        board = cv2.aruco.CharucoBoard(spec.squares, spec.square_m, spec.marker_m or 0.0, dictionary)
        board.setLegacyPattern(legacy)
        print_ = board.generateImage(tuple(n * PIXELS_PER_SQUARE for n in spec.squares))
        origin = 0.0
    else:
        columns, rows = (n + 1 for n in spec.squares)
        v, u = np.mgrid[: rows * PIXELS_PER_SQUARE, : columns * PIXELS_PER_SQUARE] // PIXELS_PER_SQUARE
        print_ = np.where((u + v) % 2 == 0, 0, 255).astype(np.uint8)
        origin = -spec.square_m
    # print pixel (centre of the first at 0.5) -> board metres -> picture pixel (centre of the first at 0.5)
    metres = spec.square_m / PIXELS_PER_SQUARE
    board_from_print = np.array([[metres, 0, origin], [0, metres, origin], [0, 0, 1.0]])
    H = K @ np.column_stack([cam_from_board[:, :2], cam_from_board[:, 3]]) @ board_from_print
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    H = np.linalg.inv(half) @ H @ half  # OpenCV counts centres from 0
    fine = np.diag([4.0, 4.0, 1.0])
    fine[:2, 2] = 1.5  # four subpixels per pixel, then averaged
    big = cv2.warpPerspective(print_, fine @ H, (4 * SIZE[0], 4 * SIZE[1]), borderValue=200)
    picture = cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA)
    return 255 - picture if inverted else picture


def write(folder: Path, pictures: list[np.ndarray]) -> list[Path]:
    files = []
    for n, picture in enumerate(pictures):
        files.append(folder / f"{n:03d}.png")
        cv2.imwrite(str(files[-1]), picture)
    return files


def exact_views(count: int, noise_px: float = 0.0, seed: int = 0) -> list[BoardView]:
    rng = np.random.default_rng(seed)
    views = []
    for n in range(count):
        camera = Camera(*SIZE, K, board_pose(rng, SPEC, 0.35), np.array([K1, 0, 0, 0, 0]))
        xy = camera.project(SPEC.corners)
        inside = ((xy > 0) & (xy < SIZE)).all(1)
        noise = noise_px * rng.standard_normal(xy.shape)
        views.append(BoardView(n, np.flatnonzero(inside), (xy + noise)[inside]))
    return views


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("swapped", [False, True])
def test_every_print_is_recognised(tmp_path, inverted, legacy, swapped):
    rng = np.random.default_rng(0)
    poses = [board_pose(rng, SPEC) for _ in range(3)]
    files = write(tmp_path, [draw(SPEC, pose, legacy, inverted) for pose in poses])
    told = replace(SPEC, squares=SPEC.squares[::-1]) if swapped else SPEC
    views, settled = find_board("clip", files, told)
    assert (settled.squares, settled.inverted, settled.legacy) == (SPEC.squares, inverted, legacy)
    assert len(views) == 3
    for view in views:
        true = Camera(*SIZE, K, poses[view.frame]).project(SPEC.corners)[view.ids]
        error = view.xy - true
        assert len(view.ids) >= 12
        assert np.median(np.linalg.norm(error, axis=1)) < 0.25  # what OpenCV's corner refinement reaches here
        assert np.abs(error.mean(0)).max() < 0.2  # no half pixel anywhere


def test_chessboard_corners_lie_where_they_should(tmp_path):
    spec = BoardSpec("chessboard", (7, 4), 0.04)
    rng = np.random.default_rng(2)
    poses = [board_pose(rng, spec) for _ in range(3)]
    views, _ = find_board("clip", write(tmp_path, [draw(spec, p) for p in poses]), spec)
    assert len(views) == 3
    for view in views:
        true = Camera(*SIZE, K, poses[view.frame]).project(spec.corners)[view.ids]
        assert np.linalg.norm(view.xy - true, axis=1).max() < 0.3  # also: the same corner comes first


def test_a_board_that_is_never_seen_is_refused(tmp_path):
    files = write(tmp_path, [np.full((120, 160), 128, dtype=np.uint8)] * 3)
    with pytest.raises(
        HealthError, match=r"board never seen in clip7: 0 of 3 frames.*check squares and dictionary"
    ):
        find_board("clip7", files, SPEC)
    assert find_board("clip7", files, SPEC, required=False)[0] == []


def test_a_wrong_description_is_refused(tmp_path):
    files = write(tmp_path, [draw(SPEC, board_pose(np.random.default_rng(1), SPEC))])
    with pytest.raises(HealthError, match="fit no 9x7 layout"):
        settle("clip", files, replace(SPEC, squares=(9, 7)))
    with pytest.raises(InputError, match="DICT_9X9_7 is unknown"):
        settle("clip", files, replace(SPEC, dictionary="DICT_9X9_7"))


def test_intrinsics_of_exact_views():
    found = calibrate_intrinsics("cam0", exact_views(14), SPEC, SIZE)
    np.testing.assert_allclose(found.intrinsics.K, K, atol=0.05)
    assert found.intrinsics.distortion[0] == pytest.approx(K1, abs=1e-3)
    assert found.rms_px < 0.01
    assert not found.intrinsics.distortion[2:].any()  # no more terms than the views support


def test_intrinsics_of_noisy_views_are_within_their_doubt():
    found = calibrate_intrinsics("cam0", exact_views(20, 0.2), SPEC, SIZE)
    std = found.intrinsics.std
    assert std is not None
    true = np.array([520.0, 520.0, 322.0, 237.0, K1])
    assert (np.abs(found.intrinsics.vector[:5] - true) < 4 * std[:5] + 1e-9).all()
    assert 0.2 < found.rms_px < 0.35  # 0.2 px per coordinate is 0.28 px per corner


def test_the_same_views_give_the_same_intrinsics_to_the_last_bit():
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(4)  # OpenCV sums over views in them, in any order
        views = exact_views(20, 0.2)
        found = [calibrate_intrinsics("cam0", views, SPEC, SIZE).intrinsics.vector for _ in range(6)]
        assert all((other == found[0]).all() for other in found) and cv2.getNumThreads() == 4
    finally:
        cv2.setNumThreads(threads)


def test_a_bad_view_is_dropped():
    views = exact_views(12, 0.1)
    bad = views[5]
    views[5] = replace(bad, xy=np.roll(bad.xy, 3, axis=0))
    found = calibrate_intrinsics("cam0", views, SPEC, SIZE)
    assert found.dropped == (5,)
    assert found.rms_px < 0.3


def test_too_few_views_are_refused():
    with pytest.raises(HealthError, match="camera 'cam3': the board is seen in 2 pictures, need 4"):
        calibrate_intrinsics("cam3", exact_views(2), SPEC, SIZE)


def test_coverage_counts_cells():
    view = BoardView(0, np.arange(2), np.array([[1.0, 1.0], [639.0, 479.0]]))
    assert coverage([view], SIZE) == pytest.approx(2 / 25)


def test_real_inverted_print(data_dir, tmp_path):
    """A webcam clip of the caliscope session: 4 x 5 squares, white on black."""
    import av

    clip = data_dir / "caliscope_post_optimization" / "calibration" / "extrinsic" / "cam_2.mp4"
    with av.open(str(clip)) as container:
        frames = [f.to_ndarray(format="gray") for n, f in enumerate(container.decode(video=0)) if n % 8 == 0]
    spec = BoardSpec("charuco", (4, 5), 0.054, 0.0405, "DICT_4X4_1000")
    views, settled = find_board("cam_2", write(tmp_path, frames), spec)
    assert settled.inverted is True and settled.squares == (4, 5)
    assert len(views) >= 5
