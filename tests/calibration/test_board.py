"""Boards rendered with known places, in every way they are printed and described."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.refused import refused

from devrf.calibration.boards.detect import CHESSBOARD_TRIES, detector, fixes_pose, misfit
from devrf.calibration.boards.find import BoardSpec, find_board
from devrf.calibration.boards.guess import guess_board
from devrf.calibration.boards.layout import settle
from devrf.capture.camera import Camera
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.errors import HealthError, InputError

SPEC = BoardSpec("charuco", (6, 4), 0.05, 0.0375, "DICT_5X5_100")
PIXELS_PER_SQUARE = 60
SIZE = (640, 480)
K = np.array([[520.0, 0, 322.0], [0, 520.0, 237.0], [0, 0, 1]])


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
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, spec.dictionary))
    if spec.type == "aruco_grid" and spec.order != "down":
        print_ = from_below(spec)
        origin = (spec.marker_m or 0.0) - spec.square_m
    elif spec.type == "aruco_grid":
        assert spec.marker_m is not None
        gap = round((spec.square_m - spec.marker_m) / spec.square_m * PIXELS_PER_SQUARE)
        ids = spec.first_id + np.arange(spec.squares[0] * spec.squares[1])
        grid = cv2.aruco.GridBoard(
            spec.squares, spec.marker_m, spec.square_m - spec.marker_m, dictionary, ids
        )
        size = tuple(n * PIXELS_PER_SQUARE + gap for n in spec.squares)  # a gap's width of margin all around
        print_ = grid.generateImage(size, marginSize=gap)
        origin = spec.marker_m - spec.square_m
    elif spec.type == "charuco":
        ids = spec.first_id + np.arange(spec.squares[0] * spec.squares[1] // 2)
        board = cv2.aruco.CharucoBoard(spec.squares, spec.square_m, spec.marker_m or 0.0, dictionary, ids)
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


@pytest.mark.parametrize(
    ("ids", "fixes"),
    [
        ([0, 1, 2, 3, 4, 5, 6], True),
        ([0, 1, 2, 3, 4, 5], False),  # the last of them alone is on the second row
        ([0, 1, 2, 3, 4], False),
        ([0, 1, 2, 5, 6], False),  # too few
        ([0, 6, 12, 3, 8, 13], True),
    ],
)
def test_corners_on_one_line_do_not_fix_a_pose(ids: list[int], fixes: bool) -> None:
    assert SPEC.squares == (6, 4)  # five corners in a row
    assert fixes_pose(SPEC, np.array(ids)) == fixes


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
    assert settled.corrections == ((("squares", "[6, 4]"),) if swapped else ())
    assert len(views) == 3
    for view in views:
        true = Camera(*SIZE, K, poses[view.frame]).project(SPEC.corners)[view.ids]
        error = view.xy - true
        assert len(view.ids) >= 12
        assert np.median(np.linalg.norm(error, axis=1)) < 0.25  # what OpenCV's corner refinement reaches here
        assert np.abs(error.mean(0)).max() < 0.2  # no half pixel anywhere
    again, same = find_board("clip", files, settled)  # told what was settled, it is settled alike
    assert same == replace(settled, corrections=())
    assert all(np.array_equal(a.xy, b.xy) for a, b in zip(again, views, strict=True))


@pytest.mark.parametrize("key", ["legacy", "inverted"])
def test_a_wrong_description_of_the_print_is_corrected(tmp_path, key):
    """What was said is tried first, and what pictures show is kept."""
    rng = np.random.default_rng(0)
    files = write(tmp_path, [draw(SPEC, board_pose(rng, SPEC)) for _ in range(2)])
    told = {"legacy": False, "inverted": False} | {key: True}
    views, settled = find_board("clip", files, replace(SPEC, **told))
    assert len(views) == 2 and settled.corrections == ((key, "false"),)
    assert find_board("clip", files, replace(SPEC, legacy=False, inverted=False))[1].corrections == ()


@pytest.mark.parametrize("swapped", [False, True])
def test_grids_of_markers(tmp_path, swapped):
    spec = BoardSpec("aruco_grid", (5, 4), 0.06, 0.045)
    rng = np.random.default_rng(3)
    poses = [board_pose(rng, spec, 0.6) for _ in range(3)]
    told = replace(spec, squares=(4, 5)) if swapped else spec
    views, settled = find_board("clip", write(tmp_path, [draw(spec, p) for p in poses]), told)
    assert settled.squares == (5, 4) and len(views) == 3
    for view in views:
        true = Camera(*SIZE, K, poses[view.frame]).project(spec.corners)[view.ids]
        assert len(view.ids) >= 32
        error = np.linalg.norm(view.xy - true, axis=1)
        assert np.median(error) < 0.3  # corners of squares, not crossings: a third of a pixel is usual


def test_chessboard_corners_lie_where_they_should(tmp_path):
    spec = BoardSpec("chessboard", (7, 4), 0.04)
    rng = np.random.default_rng(2)
    poses = [board_pose(rng, spec) for _ in range(3)]
    views, _ = find_board("clip", write(tmp_path, [draw(spec, p) for p in poses]), spec)
    assert len(views) == 3
    for view in views:
        true = Camera(*SIZE, K, poses[view.frame]).project(spec.corners)[view.ids]
        assert np.linalg.norm(view.xy - true, axis=1).max() < 0.3  # also: the same corner comes first


@pytest.mark.parametrize("told", [(4, 7), (8, 5), (5, 8)])
def test_a_chessboard_described_turned_or_by_its_squares_is_found(tmp_path, told):
    spec = BoardSpec("chessboard", (7, 4), 0.04)
    rng = np.random.default_rng(2)
    files = write(tmp_path, [draw(spec, board_pose(rng, spec)) for _ in range(2)])
    views, settled = find_board("clip", files, replace(spec, squares=told))
    assert sorted(settled.squares) == [4, 7] and len(views) == 2
    if sorted(told) != [4, 7]:
        assert settled.corrections == (("squares", f"[{settled.squares[0]}, {settled.squares[1]}]"),)


@pytest.mark.full
def test_corners_are_refined_where_that_makes_them_smoother(data_dir):
    """A quarter less noise on small sharp squares; nothing lost on large blurred ones."""
    for name, squares in (
        ("opencv_stereo_chessboard/left07.jpg", (9, 6)),
        ("pose2sim_single/calibration/intrinsics/int_cam03_img/cam03_02_int.jpg", (7, 4)),
    ):
        spec = BoardSpec("chessboard", squares, 0.03)
        grey = read_grey(data_dir / name)
        ids, xy = detector(spec)(grey)
        raw = cv2.findChessboardCornersSB(grey, squares, flags=CHESSBOARD_TRIES[0])[1].reshape(-1, 2)
        assert misfit(spec, ids, xy) <= misfit(spec, ids, raw.astype(np.float64)) + 1e-6
        if "left07" in name:
            assert misfit(spec, ids, xy) < 0.75 * misfit(spec, ids, raw.astype(np.float64))


@pytest.mark.full
def test_misread_corners_are_refused_and_looked_for_again(data_dir):
    """Photo 7 of cam04: the board is cut by the picture's edge, and a row of corners is taken from a shirt."""
    file = data_dir / "pose2sim_single/calibration/intrinsics/int_cam04_img/cam04_07_int.jpg"
    spec, grey = BoardSpec("chessboard", (7, 4), 0.06), read_grey(file)
    cv2.setRNGSeed(0)
    raw = cv2.findChessboardCornersSB(grey, spec.squares, flags=CHESSBOARD_TRIES[0])[1].reshape(-1, 2)
    assert misfit(spec, np.arange(28), raw.astype(np.float64)) > 10
    assert len(detector(spec)(grey)[0]) == 0
    ids, xy = detector(spec, second_try=True)(grey)
    assert misfit(spec, ids, xy) < 0.5


@pytest.mark.full
def test_the_same_picture_gives_the_same_corners(data_dir):
    """OpenCV's chessboard detector draws random numbers: of this photo it misreads the board now and then."""
    file = data_dir / "pose2sim_single/calibration/intrinsics/int_cam01_img/cam01_05_int.jpg"
    detect, grey = detector(BoardSpec("chessboard", (7, 4), 0.06)), read_grey(file)
    first, second = detect(grey)[1], detect(grey)[1]
    assert len(first) == 28
    np.testing.assert_array_equal(first, second)


@pytest.mark.full
def test_real_chessboards_are_found(data_dir):
    """A photo without the 9x6 board, one blurred, one of another camera."""
    names = ("cam_0_frame_000.jpg", "cam_0_frame_300.jpg", "cam_2_frame_1070.jpg")
    files = [data_dir / "caliscope_chessboard_intrinsic" / name for name in names]
    views, _ = find_board("photos", files, BoardSpec("chessboard", (9, 6), 0.03))
    assert [v.frame for v in views] == [1, 2]
    assert views[0].blur > 0.2 > views[1].blur


@pytest.mark.parametrize("spec", [SPEC, BoardSpec("chessboard", (7, 4), 0.04)])
def test_the_width_of_edges_shows_blur(tmp_path, spec):
    """A box of n pixels turns a sharp edge into a ramp of n pixels, of which 10 to 90 % are 0.8 n."""
    pose = np.column_stack([np.eye(3), [-0.14, -0.1, 0.42]])
    sharp = draw(spec, pose)
    smeared = cv2.blur(sharp, (7, 1))  # motion along x
    views, _ = find_board("clip", write(tmp_path, [sharp, smeared]), spec)
    assert views[0].blur_px < 1.8
    # the sharp edge's own pixel and sampling come on top
    assert 0.8 * 7 - 0.7 < views[1].blur_px < 0.8 * 7 + 1.5
    side_px = K[0, 0] * spec.square_m / 0.42
    assert views[1].blur == pytest.approx(views[1].blur_px / side_px, rel=0.02)


def test_a_board_that_is_never_seen_is_refused(tmp_path):
    files = write(tmp_path, [np.full((120, 160), 128, dtype=np.uint8)] * 3)
    with refused("board-never-seen", "clip7", "0 of 3", "squares", "dictionary", kind=HealthError):
        find_board("clip7", files, SPEC)
    assert find_board("clip7", files, SPEC, required=False)[0] == []
    with refused("board-never-seen", "squares", kind=HealthError):
        find_board("clip7", files, BoardSpec("chessboard", (7, 4), 0.04))


GRID = BoardSpec("aruco_grid", (5, 4), 0.05, 0.04, "DICT_5X5_100")
APRILGRID = BoardSpec("aruco_grid", (5, 4), 0.06, 0.05, "DICT_APRILTAG_36h11")
KALIBR = replace(APRILGRID, order="kalibr", border=2)


@pytest.mark.parametrize("spec", [SPEC, replace(SPEC, squares=(5, 7)), GRID], ids=["6x4", "5x7", "grid"])
@pytest.mark.parametrize("first", [pytest.param(1, marks=pytest.mark.full), 20])
def test_a_board_whose_first_marker_has_another_number(tmp_path, spec, first):
    rng, printed = np.random.default_rng(4), replace(spec, first_id=first)
    poses = [board_pose(rng, printed) for _ in range(3)]
    pictures = [draw(printed, pose) for pose in poses]
    views, settled = find_board("clip", write(tmp_path, pictures), spec)
    assert settled.first_id == first and settled.corrections == () and len(views) == 3
    for view, pose in zip(views, poses, strict=True):
        points = spec.corners[view.ids] @ pose[:, :3].T + pose[:, 3]
        xy = points @ K.T
        assert np.abs(xy[:, :2] / xy[:, 2:] - view.xy).max() < 0.5
    guess = guess_board(pictures)  # perhaps of a taller board, of which this is a part
    assert guess is not None and guess.spec.squares[0] == spec.squares[0]
    assert len(find_board("clip", write(tmp_path, pictures), replace(guess.spec, first_id=0))[0]) == 3


@pytest.mark.parametrize(
    ("printed", "mirrored", "named"),
    [
        (replace(SPEC, dictionary="DICT_6X6_250"), False, ("DICT_6X6_50", "ids from 0 to 11")),
        pytest.param(SPEC, True, ("DICT_5X5_50", "ids from 0 to 11", "mirror"), marks=pytest.mark.full),
        pytest.param(BoardSpec("chessboard", (8, 5), 0.05), False, ("8x5",), marks=pytest.mark.full),
        (KALIBR, False, ("DICT_APRILTAG_36h11", "ids from 0 to 19")),
    ],
    ids=["another dictionary", "mirrored", "chessboard", "Kalibr's grid"],
)
def test_what_is_seen_instead_of_the_board_is_named(tmp_path, printed, mirrored, named):
    rng = np.random.default_rng(7)
    pictures = [draw(printed, board_pose(rng, printed)) for _ in range(3)]
    files = write(tmp_path, [np.ascontiguousarray(p[:, ::-1]) if mirrored else p for p in pictures])
    with refused("board-never-seen", *named, kind=HealthError):
        find_board("clip", files, SPEC)


def from_below(spec: BoardSpec, by_columns: bool = False) -> np.ndarray:
    """A print whose markers are numbered from the bottom left; Kalibr's are upside down, with squares between them."""
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    side = round(PIXELS_PER_SQUARE * (spec.marker_m or 0.0) / spec.square_m)
    gap, (columns, rows) = PIXELS_PER_SQUARE - side, spec.squares
    sheet = np.full((rows * PIXELS_PER_SQUARE + gap, columns * PIXELS_PER_SQUARE + gap), 255, np.uint8)
    for row, column in np.ndindex(rows, columns):
        number = column * rows + row if by_columns else row * columns + column
        marker = cv2.aruco.generateImageMarker(tags, number, side, borderBits=spec.border)
        top, left = gap + (rows - 1 - row) * PIXELS_PER_SQUARE, gap + column * PIXELS_PER_SQUARE
        sheet[top : top + side, left : left + side] = marker[::-1, ::-1] if spec.order == "kalibr" else marker
    if spec.order == "kalibr":
        for row, column in np.ndindex(rows + 1, columns + 1):
            top, left = row * PIXELS_PER_SQUARE, column * PIXELS_PER_SQUARE
            sheet[top : top + gap, left : left + gap] = 0
    return sheet


@pytest.mark.parametrize(
    ("order", "border", "distance"),
    [("up", 1, 0.5), ("kalibr", 2, 0.5), pytest.param("kalibr", 2, 0.8, marks=pytest.mark.full)],
)
def test_grids_that_are_numbered_from_below(tmp_path, order, border, distance):
    """As Kalibr's aprilgrid. Near, markers with two cells of border are read as smaller ones with one, too."""
    rng, printed = np.random.default_rng(5), replace(APRILGRID, order=order, border=border)
    poses = [board_pose(rng, printed, distance) for _ in range(3)]
    pictures = [draw(printed, pose) for pose in poses]
    views, settled = find_board("clip", write(tmp_path, pictures), APRILGRID)
    assert settled == replace(printed, inverted=False, legacy=False) and len(views) == 3
    for view, pose in zip(views, poses, strict=True):
        number, corner = np.divmod(view.ids, 4)
        place = np.stack([number % 5, 3 - number // 5], axis=1) * 0.06  # from the top left marker's corner
        around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])[(corner + 2) % 4 if order == "kalibr" else corner]
        points = np.column_stack([place + 0.05 * around, np.zeros(len(place))])
        error = Camera(*SIZE, K, pose).project(points) - view.xy
        assert len(view.ids) >= 60 and np.median(np.linalg.norm(error, axis=1)) < 0.25
    guess = guess_board(pictures)
    assert guess is not None and guess.spec.squares == (5, 4)
    assert (guess.spec.order, guess.spec.border) == (order, border)
    assert guess.spec.marker_m == pytest.approx(5 / 6, abs=0.02)


def test_a_grid_that_counts_otherwise_is_named(tmp_path):
    sheet = np.pad(from_below(APRILGRID, by_columns=True), 40, constant_values=255)
    names = ("DICT_APRILTAG_36h11", "ids from 0 to 19", "row by row")
    with refused("board-layout-wrong", *names, kind=HealthError):
        find_board("clip", write(tmp_path, [sheet]), APRILGRID)


def test_a_wrong_description_is_refused(tmp_path):
    files = write(tmp_path, [draw(SPEC, board_pose(np.random.default_rng(1), SPEC))])
    with refused("board-layout-wrong", "9x7", kind=HealthError):
        settle("clip", files, replace(SPEC, squares=(9, 7)))
    with refused("board-dictionary-unknown", "DICT_9X9_7;", "mean DICT_", kind=InputError):
        settle("clip", files, replace(SPEC, dictionary="DICT_9X9_7"))


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
