"""Corners of a settled board in one picture, as exact as the picture allows, and refused where they cannot be true.

Corners come out with the centre of the top-left pixel at (0.5, 0.5). OpenCV's detectors draw random numbers;
they are seeded, so that the same picture gives the same corners.
"""

from collections.abc import Callable

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.calibration.boards.spec import BoardSpec, charuco_board, dictionary, marker_count, marker_finder

Grey = UInt8[np.ndarray, "h w"]
Found = tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]
Detector = Callable[[Grey], Found]

MIN_CORNERS = 6  # of a view that is used at all
MISREAD = 0.1  # squares; corners that lie further from a smooth picture of the board belong to other things
MIN_SMOOTH = 9  # corners of which a smooth picture can be told: its 14 unknowns leave some over
WINDOW = 0.35  # of the distance between corners: as far as an edge runs without meeting the next corner
LARGEST_WINDOW = 30  # pixels, to each side
# of a marker's side, by `border`: within the black border, a seventh of a 5x5 marker
MARKER_WINDOW = {1: 0.12, 2: 0.2}
BLUR_REACH = 0.45  # of an edge's length, to both sides of it: where black and white are read
BLUR_NEAR = 0.12  # where the edge itself must lie: markers begin beyond
BLUR_SAMPLES = 91
FAINT_STEP = 20  # grey levels
CHESSBOARD_TRIES = (  # the second finds boards cut by the picture's border, and loses some in bad light
    cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY,
    cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY,
)


def detector(spec: BoardSpec, second_try: bool = False) -> Detector:
    """A function from a grey picture to (ids, corners) of a settled board; both empty where there is none.

    Args:
        spec: The board.
        second_try: Look for a chessboard in the other way, for pictures in which the first found none.
    """
    find = {"chessboard": _chessboard, "charuco": _charuco, "aruco_grid": _aruco_grid}[spec.type]
    detect = find(spec, second_try)

    def checked(grey: Grey) -> Found:
        cv2.setRNGSeed(0)
        ids, xy = detect(255 - grey if spec.inverted is True else grey)
        if len(ids) < MIN_SMOOTH:
            return ids, xy + 0.5
        side = _side(spec, ids, xy)
        fine = refined(grey, xy, _window(spec) * side)
        xy = min((xy, fine), key=lambda corners: misfit(spec, ids, corners))
        return _nothing() if misread(spec, ids, xy) else (ids, xy + 0.5)

    return checked


def fixes_pose(spec: BoardSpec, ids: Int[np.ndarray, " n"]) -> bool:
    """Whether these corners say where the board is: enough of them, and no line holds all, or all but one."""
    at = spec.corners[ids]
    others = (np.delete(at, n, axis=0) for n in range(len(at)))
    return len(at) >= MIN_CORNERS and all(np.linalg.matrix_rank(few - few[0]) == 2 for few in others)


def misfit(spec: BoardSpec, ids: Int[np.ndarray, " n"], xy: Float[np.ndarray, "n 2"]) -> float:
    """How far corners lie from any smooth picture of the board: their noise, whatever the lens. Pixels, rms.

    Smooth is a homography and, for the lens, a quadratic polynomial.
    """
    flat = spec.corners[ids, :2] / spec.square_m
    H, _ = cv2.findHomography(flat, xy)
    if H is None:
        return np.inf
    rest = xy - cv2.perspectiveTransform(flat[:, None], H)[:, 0]
    x, y = (flat - flat.mean(0)).T
    smooth = np.column_stack([np.ones(len(x)), x, y, x * x, x * y, y * y])
    rest = rest - smooth @ np.linalg.lstsq(smooth, rest, rcond=None)[0]
    return float(np.sqrt((rest**2).sum() / max(rest.size - 14, 1)))


def misread(spec: BoardSpec, ids: Int[np.ndarray, " n"], xy: Float[np.ndarray, "n 2"]) -> bool:
    """Whether corners cannot be a picture of the board."""
    return len(ids) >= MIN_SMOOTH and misfit(spec, ids, xy) > MISREAD * _side(spec, ids, xy)


def edge_width(
    grey: Grey, spec: BoardSpec, ids: Int[np.ndarray, " n"], xy: Float[np.ndarray, "n 2"]
) -> tuple[float, float]:
    """How wide the board's edges are smeared, 10 to 90 % of the step from black to white, by their steepest place.

    Edges of one direction count together, and the worse direction counts: motion blurs in one.

    Returns:
        In lengths of the edge, and in pixels; NaN where no edge lies between two corners.
    """
    pairs = _neighbours(spec, ids)
    if len(pairs) == 0:
        return np.nan, np.nan
    a, b = xy[pairs[:, 0]] - 0.5, xy[pairs[:, 1]] - 0.5
    along = b - a
    length = np.linalg.norm(along, axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    reach = np.linspace(-BLUR_REACH, BLUR_REACH, BLUR_SAMPLES)
    middle = a[:, None, None] + np.array([0.35, 0.5, 0.65])[:, None, None] * along[:, None, None]
    points = (middle + reach[:, None] * across[:, None, None]).astype(np.float32).reshape(len(pairs), -1, 2)
    grey_levels = cv2.remap(grey, points[..., 0], points[..., 1], cv2.INTER_LINEAR)
    profile = grey_levels.reshape(len(pairs), 3, BLUR_SAMPLES).astype(np.float64).mean(axis=1)
    step = np.ptp(np.quantile(profile, [0.02, 0.98], axis=1), axis=0)
    slope = np.abs(np.gradient(profile, reach, axis=1)) / length[:, None]
    slope[np.abs(reach) * length[:, None] > np.maximum(BLUR_NEAR * length, 1.5)[:, None]] = 0.0
    clear = step > FAINT_STEP
    width = 0.8 * step / np.maximum(slope.max(axis=1), 1e-9)
    turned = np.abs(along[:, 0]) < np.abs(along[:, 1])
    sides = [s for s in (clear & turned, clear & ~turned) if s.any()]
    if not sides:
        return np.nan, np.nan
    return max(float(np.median((width / length)[s])) for s in sides), max(
        float(np.median(width[s])) for s in sides
    )


def _nothing() -> Found:
    return np.zeros(0, dtype=np.int64), np.zeros((0, 2))


def _charuco(spec: BoardSpec, _second_try: bool) -> Detector:
    charuco = cv2.aruco.CharucoDetector(charuco_board(spec))

    def detect(grey: Grey) -> Found:
        corners, ids, _, _ = charuco.detectBoard(grey)
        if ids is None or len(ids) == 0:
            return _nothing()
        return np.asarray(ids).reshape(-1).astype(np.int64), np.asarray(corners, np.float64).reshape(-1, 2)

    return detect


def _aruco_grid(spec: BoardSpec, _second_try: bool) -> Detector:
    finder = marker_finder(dictionary(spec.dictionary), spec.border)
    count = marker_count(spec)

    def detect(grey: Grey) -> Found:
        quads, ids, _ = finder.detectMarkers(grey)
        if ids is None or len(ids) == 0:
            return _nothing()
        numbers = np.asarray(ids).reshape(-1).astype(np.int64) - spec.first_id
        ours = (numbers >= 0) & (numbers < count)
        corners = np.asarray(quads, np.float64).reshape(-1, 4, 2)[ours]
        return (4 * numbers[ours][:, None] + np.arange(4)).reshape(-1), corners.reshape(-1, 2)

    return detect


def _chessboard(spec: BoardSpec, second_try: bool) -> Detector:
    flags = CHESSBOARD_TRIES[second_try]

    def detect(grey: Grey) -> Found:
        found, corners = cv2.findChessboardCornersSB(grey, spec.squares, flags=flags)
        if not found:
            return _nothing()
        xy = np.asarray(corners, np.float64).reshape(-1, 2)
        if sum(spec.squares) % 2 == 1 and _first_square_is_light(grey, xy, spec):
            xy = xy[::-1].copy()  # half a turn: the detector may start at either end
        return np.arange(len(xy)), xy

    return detect


def _first_square_is_light(grey: Grey, xy: Float[np.ndarray, "n 2"], spec: BoardSpec) -> bool:
    """Whether the square between the first four corners is lighter than its neighbour in the row."""
    columns = spec.squares[0]
    if columns < 3:
        return False
    first = xy[[0, 1, columns, columns + 1]].mean(0)
    second = xy[[1, 2, columns + 1, columns + 2]].mean(0)
    (u0, v0), (u1, v1) = first.round().astype(int), second.round().astype(int)
    return bool(grey[v0, u0] > grey[v1, u1])


def _side(spec: BoardSpec, ids: Int[np.ndarray, " n"], xy: Float[np.ndarray, "n 2"]) -> float:
    """Shortest distance between neighbouring corners, pixels."""
    pairs = _neighbours(spec, ids)
    return float(np.linalg.norm(xy[pairs[:, 0]] - xy[pairs[:, 1]], axis=1).min(initial=np.inf))


def _neighbours(spec: BoardSpec, ids: Int[np.ndarray, " n"]) -> Int[np.ndarray, "m 2"]:
    """Places in `ids` of corners that an edge of the board joins."""
    place = np.full(len(spec.corners), -1)
    place[ids] = np.arange(len(ids))
    pairs = place[spec.edges]
    return pairs[(pairs >= 0).all(axis=1)]


def _window(spec: BoardSpec) -> float:
    """How far around a corner nothing else is printed, in lengths of an edge."""
    if spec.type != "aruco_grid" or spec.marker_m is None:
        return WINDOW
    return min(MARKER_WINDOW[spec.border], spec.square_m / spec.marker_m - 1)


def refined(grey: Grey, xy: Float[np.ndarray, "n 2"], window_px: float) -> Float[np.ndarray, "n 2"]:
    """Corners by the gradients around them (cornerSubPix), so far to each side."""
    window = int(np.clip(window_px, 2, LARGEST_WINDOW))
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)
    fine = cv2.cornerSubPix(
        grey, xy.astype(np.float32).reshape(-1, 1, 2).copy(), (window, window), (-1, -1), stop
    )
    return np.asarray(fine, np.float64).reshape(-1, 2)
