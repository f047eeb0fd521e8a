"""Calibrations of single cameras by boards, by the stages' own entry points with production defaults.

`opencv_stereo_chessboard`: reprojection errors, counted as OpenCV counts (root mean square per corner), beside what
OpenCV's own solvers reach on the same corners. `pose2sim_single`: seven photos per camera; focal lengths against
Qualisys. `caliscope_chessboard_intrinsic`: is the board found. Simulated views: do the standard deviations hold.
"""

from pathlib import Path

import cv2
import numpy as np

from devrf.calibration.boards.calibrate import FIVE_COEFFICIENTS, BoardCalibration, calibrate_intrinsics
from devrf.calibration.boards.find import BoardSpec, BoardView, find_board
from devrf.calibration.boards.simulated import FOCAL, SIZE, SPEC, board_views
from devrf.calibration.rigs.board_route import TimedView, rig_from_board
from devrf.calibration.rigs.given import read_given
from devrf.pipelines.bench.accuracy.cases import Cases, not_there
from devrf.pipelines.bench.rows import Row, with_goal

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


def boards(cases: Cases) -> list[Row]:
    """Errors, focal lengths with their doubt, boards found, and whether the doubt is honest."""
    rows: list[Row] = []
    for name, measure in ((STEREO, _stereo), (POSE2SIM, _pose2sim), (CALISCOPE, _caliscope)):
        folder = cases.real(name)
        rows += [not_there(f"boards/{name}", "px", name)] if folder is None else measure(folder)
    return rows + _simulated()


def _stereo(folder: Path) -> list[Row]:
    rows: list[Row] = []
    spec = BoardSpec("chessboard", (9, 6), 0.025)
    views, calibrations = {}, {}
    for side in ("left", "right"):
        views[side], _ = find_board(side, sorted(folder.glob(f"{side}[0-9]*.jpg")), spec)
        five = calibrations[side] = calibrate_intrinsics(
            side, views[side], spec, (640, 480), terms=FIVE_COEFFICIENTS
        )
        own = calibrate_intrinsics(side, views[side], spec, (640, 480))
        prefix = f"boards/{STEREO}/{side}"
        rows += [
            _rms(f"{prefix}/rms, five coefficients", five.rms_px, side),
            Row(f"{prefix}/rms, OpenCV's solver on these corners", _opencv_mono(views[side], spec)[0], "px"),
            Row(f"{prefix}/rms, lens chosen: {own.terms.words}", own.rms_px, "px"),
            Row(f"{prefix}/rms, views held out", own.held_out_rms_px, "px"),
            Row(f"{prefix}/bow of the board", abs(five.bow_mm[1]), "mm", spread=five.bow_std_mm[1]),
        ]
        rows += [
            Row(f"{prefix}/{what}", float(value), "px", spread=float(std))
            for what, value, std in zip(
                ("fx", "fy", "cx", "cy"), five.intrinsics.vector, _std(five), strict=False
            )
        ]
    lenses = {side: c.intrinsics for side, c in calibrations.items()}
    timed = {side: [TimedView(v, float(v.frame)) for v in views[side]] for side in views}
    rig = rig_from_board(timed, spec, lenses, lenses)
    left, right = rig.cameras["left"], rig.cameras["right"]
    rows += [
        _rms(f"boards/{STEREO}/stereo rms, five coefficients", rig.rms_px, "stereo"),
        Row(
            f"boards/{STEREO}/stereo rms, OpenCV's solver on these corners", _opencv_stereo(views, spec), "px"
        ),
        Row(f"boards/{STEREO}/baseline", 1e3 * float(np.linalg.norm(right.centre - left.centre)), "mm"),
    ]
    return rows


def _rms(name: str, value: float, which: str) -> Row:
    goal = STEREO_RMS_PX[which]
    return with_goal(Row(name, value, "px", anchor=goal, source=STEREO_SOURCE), goal, low_is_good=True)


def _std(calibration: BoardCalibration) -> np.ndarray:
    assert calibration.intrinsics.std is not None
    return calibration.intrinsics.std


def _opencv_mono(views: list[BoardView], spec: BoardSpec) -> tuple[float, np.ndarray, np.ndarray]:
    """rms, K and distortion of OpenCV's solver."""
    rms, K, lens, *_ = cv2.calibrateCamera(
        [spec.corners[v.ids].astype(np.float32) for v in views],
        [(v.xy - 0.5).astype(np.float32) for v in views],
        (640, 480),
        np.eye(3),
        np.zeros(5),
    )
    return float(rms), np.asarray(K), np.asarray(lens)


def _opencv_stereo(views: dict[str, list[BoardView]], spec: BoardSpec) -> float:
    """OpenCV's stereo error, intrinsics refined from its own."""
    right = {v.frame: v for v in views["right"]}
    pairs = [(v, right[v.frame]) for v in views["left"] if v.frame in right]
    _, K1, lens1 = _opencv_mono(views["left"], spec)
    _, K2, lens2 = _opencv_mono(views["right"], spec)
    return float(
        cv2.stereoCalibrate(
            [spec.corners.astype(np.float32) for _ in pairs],
            [(a.xy - 0.5).astype(np.float32) for a, _ in pairs],
            [(b.xy - 0.5).astype(np.float32) for _, b in pairs],
            K1,
            lens1,
            K2,
            lens2,
            (640, 480),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        )[0]
    )


def _pose2sim(folder: Path) -> list[Row]:
    spec, rows = BoardSpec("chessboard", (7, 4), 0.06), []
    photos = {
        name: sorted((folder / "calibration" / "intrinsics" / f"int_{name}_img").glob("*.jpg"))
        for name in POSE2SIM_NAIVE
    }
    sizes = dict.fromkeys(photos, (1088, 1920))
    reference = read_given(folder / "calibration" / "Calib.qca.txt", list(photos), sizes).intrinsics
    found = {}
    for name, files in photos.items():
        views, _ = find_board(name, files, spec)
        found[name] = calibrate_intrinsics(name, views, spec, sizes[name])
        k = found[name].intrinsics
        focal, true = k.K[[0, 1], [0, 1]].mean(), reference[name].K[[0, 1], [0, 1]].mean()
        std = 100 * float(_std(found[name])[0] / focal)
        off = Row(
            f"boards/{POSE2SIM}/{name}/focal, off by ({found[name].terms.words}, {len(views)} views)",
            100 * abs(float(focal / true) - 1),
            "%",
            spread=std,
            anchor=POSE2SIM_NAIVE[name],
            source=POSE2SIM_SOURCE,
        )
        rows += [
            with_goal(off, max(0.5, 2 * std), low_is_good=True),
            Row(f"boards/{POSE2SIM}/{name}/rms", found[name].rms_px, "px"),
        ]
    focals = [c.intrinsics.K[0, 0] for c in found.values()]
    true = [k.K[0, 0] for k in reference.values()]
    return rows + [
        Row(
            f"boards/{POSE2SIM}/focal, spread over the four cameras",
            100 * float(np.ptp(focals) / np.mean(focals)),
            "%",
        ),
        Row(f"boards/{POSE2SIM}/the same of Qualisys", 100 * float(np.ptp(true) / np.mean(true)), "%"),
    ]


def _caliscope(folder: Path) -> list[Row]:
    files = sorted(folder.glob("*.jpg"))
    views, _ = find_board("photos", files, BoardSpec("chessboard", (9, 6), 0.03))
    seen = {files[v.frame].name for v in views}
    right = sum((file.name in seen) == (file.name != WITHOUT_BOARD) for file in files)
    return [with_goal(Row(f"boards/{CALISCOPE}/photos of 8 judged right", float(right), ""), 8.0)]


def _simulated() -> list[Row]:
    """Share of seeds in which the focal length lies within two standard deviations."""
    rows: list[Row] = []
    for case, count, common_px in (
        ("20 views, 0.3 px", 20, 0.0),
        ("8 views, 0.3 px", 8, 0.0),
        ("20 views, 0.3 px and 0.2 px shared by a view", 20, 0.2),
    ):
        error, std = [], []
        for seed in range(SEEDS):
            views = board_views(count, 0.3, seed, common_px=common_px)
            k = calibrate_intrinsics("simulated", views, SPEC, SIZE).intrinsics
            assert k.std is not None
            error.append(k.K[0, 0] - FOCAL)
            std.append(k.std[0])
        inside = float(np.mean(np.abs(error) < 2 * np.array(std)))
        rms, doubt = float(np.sqrt(np.mean(np.square(error)))), float(np.median(std))
        rows += [
            with_goal(Row(f"boards/simulated, {case}/focal within 2 std", inside, "of seeds"), 0.9),
            Row(f"boards/simulated, {case}/focal, rms error", 100 * rms / FOCAL, "%"),
            Row(f"boards/simulated, {case}/focal, standard deviation given", 100 * doubt / FOCAL, "%"),
        ]
    return rows
