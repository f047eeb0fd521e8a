"""Calibrations of single cameras by boards, by the stages' own entry points with production defaults.

`opencv_stereo_chessboard`: reprojection errors, counted as OpenCV counts (root mean square per corner), beside what
OpenCV's own solvers reach on the same corners. `pose2sim_single`: seven photos per camera; focal lengths against
Qualisys. `caliscope_chessboard_intrinsic`: is the board found. Simulated views: do the standard deviations hold.
"""

from pathlib import Path

import cv2
import numpy as np

from devrf.calibration.boards.calibrate import FIVE_COEFFICIENTS, calibrate_intrinsics
from devrf.calibration.boards.find import BoardSpec, BoardView, find_board
from devrf.calibration.rigs.board_route import TimedView, rig_from_board
from devrf.calibration.rigs.given import read_given
from devrf.lab.bench.accuracy.cases import Cases
from devrf.lab.bench.accuracy.simulated_boards import FOCAL, SIZE, SPEC, board_views
from devrf.lab.bench.bench_rows import Row

STEREO = "opencv_stereo_chessboard"
STEREO_RMS_PX = {"left": 0.195, "right": 0.207, "stereo": 0.217}
STEREO_SOURCE = (
    "OpenCV 5 on corners of findChessboardCorners and cornerSubPix, five coefficients; OpenCV's pictures"
)
POSE2SIM = "pose2sim_single"
POSE2SIM_NAIVE = {"cam01": 0.49, "cam02": 1.00, "cam03": 0.59, "cam04": 0.91}
POSE2SIM_SOURCE = (
    "OpenCV 5, k1 and k2, on the same photos (naive fit); focal lengths against Qualisys (Calib.qca.txt)"
)
CALISCOPE = "caliscope_chessboard_intrinsic"
WITHOUT_BOARD = "cam_0_frame_000.jpg"
SEEDS = 40
SIMULATED = {
    "20 views, 0.3 px": (20, 0.0),
    "8 views, 0.3 px": (8, 0.0),
    "20 views, 0.3 px and 0.2 px shared by a view": (20, 0.2),
}
"""By case: how many views, and the error that the corners of a view share, px."""


def boards(cases: Cases) -> list[Row]:
    """Errors, focal lengths with their doubt, boards found, and whether the doubt is honest."""
    rows: list[Row] = []
    for name, measure in ((STEREO, _stereo), (POSE2SIM, _pose2sim), (CALISCOPE, _caliscope)):
        rows += cases.measured(name, f"boards/{name}", "px", measure)
    return rows + _simulated()


def _stereo(prefix: str, folder: Path) -> list[Row]:
    rows: list[Row] = []
    spec, size = BoardSpec("chessboard", (9, 6), 0.025), (640, 480)
    views, lenses = {}, {}
    for side in ("left", "right"):
        seen = views[side] = find_board(side, sorted(folder.glob(f"{side}[0-9]*.jpg")), spec)[0]
        five = calibrate_intrinsics(side, seen, spec, size, lens=FIVE_COEFFICIENTS)
        own = calibrate_intrinsics(side, seen, spec, size)
        k = lenses[side] = five.intrinsics
        assert k.std is not None
        at = f"{prefix}/{side}"
        rows += [
            _rms(f"{at}/rms, five coefficients", five.rms_px, side),
            Row(f"{at}/rms, OpenCV's solver on these corners", _opencv_mono(seen, spec)[0], "px"),
            Row(f"{at}/rms, lens chosen: {own.terms.words}", own.rms_px, "px"),
            Row(f"{at}/rms, views held out", own.held_out_rms_px, "px"),
            Row(f"{at}/bow of the board", abs(five.bow_mm[1]), "mm", spread=five.bow_std_mm[1]),
            *(
                Row(f"{at}/{what}", float(k.vector[n]), "px", spread=float(k.std[n]))
                for n, what in enumerate(("fx", "fy", "cx", "cy"))
            ),
        ]
    timed = {side: [TimedView(v, float(v.frame)) for v in views[side]] for side in views}
    rig = rig_from_board(timed, spec, lenses, lenses)
    apart = rig.cameras["right"].centre - rig.cameras["left"].centre
    both = _opencv_stereo(views, spec)
    return [
        *rows,
        _rms(f"{prefix}/stereo rms, five coefficients", rig.rms_px, "stereo"),
        Row(f"{prefix}/stereo rms, OpenCV's solver on these corners", both, "px"),
        Row(f"{prefix}/baseline", 1e3 * float(np.linalg.norm(apart)), "mm"),
    ]


def _rms(name: str, value: float, which: str) -> Row:
    anchor = STEREO_RMS_PX[which]
    return Row(name, value, "px", anchor=anchor, source=STEREO_SOURCE).at_most(anchor)


def _opencv_mono(views: list[BoardView], spec: BoardSpec) -> tuple[float, np.ndarray, np.ndarray]:
    """rms, K and distortion of OpenCV's solver."""
    there = [spec.corners[v.ids].astype(np.float32) for v in views]
    seen = [(v.xy - 0.5).astype(np.float32) for v in views]
    rms, K, lens, *_ = cv2.calibrateCamera(there, seen, (640, 480), np.eye(3), np.zeros(5))
    return float(rms), np.asarray(K), np.asarray(lens)


def _opencv_stereo(views: dict[str, list[BoardView]], spec: BoardSpec) -> float:
    """OpenCV's stereo error, intrinsics refined from its own."""
    right = {v.frame: v for v in views["right"]}
    pairs = [(v, right[v.frame]) for v in views["left"] if v.frame in right]
    one, two = ([(v.xy - 0.5).astype(np.float32) for v in of] for of in zip(*pairs, strict=True))
    (_, K1, lens1), (_, K2, lens2) = (_opencv_mono(views[side], spec) for side in ("left", "right"))
    there, guessed = [spec.corners.astype(np.float32)] * len(pairs), cv2.CALIB_USE_INTRINSIC_GUESS
    found = cv2.stereoCalibrate(there, one, two, K1, lens1, K2, lens2, (640, 480), flags=guessed)
    return float(found[0])


def _pose2sim(prefix: str, folder: Path) -> list[Row]:
    spec, size = BoardSpec("chessboard", (7, 4), 0.06), (1088, 1920)
    sizes = dict.fromkeys(POSE2SIM_NAIVE, size)
    given = read_given(folder / "calibration" / "Calib.qca.txt", list(sizes), sizes).intrinsics
    rows, ours, theirs = [], [], []
    for name, naive in POSE2SIM_NAIVE.items():
        photos = sorted((folder / "calibration" / "intrinsics" / f"int_{name}_img").glob("*.jpg"))
        views, _ = find_board(name, photos, spec)
        found = calibrate_intrinsics(name, views, spec, size)
        k, true = found.intrinsics, given[name].K
        assert k.std is not None
        ours.append(k.K[0, 0])
        theirs.append(true[0, 0])
        focal = k.K[[0, 1], [0, 1]].mean()
        std = 100 * float(k.std[0] / focal)
        off = 100 * abs(float(focal / true[[0, 1], [0, 1]].mean()) - 1)
        title = f"{prefix}/{name}/focal, off by ({found.terms.words}, {len(views)} views)"
        rows += [
            Row(title, off, "%", std, naive, POSE2SIM_SOURCE).at_most(max(0.5, 2 * std)),
            Row(f"{prefix}/{name}/rms", found.rms_px, "px"),
        ]
    ours_apart, theirs_apart = (100 * float(np.ptp(of) / np.mean(of)) for of in (ours, theirs))
    return [
        *rows,
        Row(f"{prefix}/focal, spread over the four cameras", ours_apart, "%"),
        Row(f"{prefix}/the same of Qualisys", theirs_apart, "%"),
    ]


def _caliscope(prefix: str, folder: Path) -> list[Row]:
    files = sorted(folder.glob("*.jpg"))
    views, _ = find_board("photos", files, BoardSpec("chessboard", (9, 6), 0.03))
    seen = {files[v.frame].name for v in views}
    right = sum((file.name in seen) == (file.name != WITHOUT_BOARD) for file in files)
    return [Row(f"{prefix}/photos of 8 judged right", float(right), "").at_least(8.0)]


def _simulated() -> list[Row]:
    """Share of seeds in which the focal length lies within two standard deviations."""
    rows: list[Row] = []
    for case, (count, common_px) in SIMULATED.items():
        error, std = np.zeros(SEEDS), np.zeros(SEEDS)
        for seed in range(SEEDS):
            views = board_views(count, 0.3, seed, common_px=common_px)
            k = calibrate_intrinsics("simulated", views, SPEC, SIZE).intrinsics
            assert k.std is not None
            error[seed], std[seed] = k.K[0, 0] - FOCAL, k.std[0]
        inside, rms = float(np.mean(np.abs(error) < 2 * std)), float(np.sqrt(np.mean(error**2)))
        at = f"boards/simulated, {case}/focal"
        rows += [
            Row(f"{at} within 2 std", inside, "of seeds").at_least(0.9),
            Row(f"{at}, rms error", 100 * rms / FOCAL, "%"),
            Row(f"{at}, standard deviation given", 100 * float(np.median(std)) / FOCAL, "%"),
        ]
    return rows
