"""Calibration boards in pictures: ChArUco and chessboard, however they were printed.

A board can be inverted (white on black), of the layout before OpenCV 4.6 ("legacy"), or described with rows
and columns swapped. A wrong description still detects, with nonsense corners; what is right shows in the
markers: their corners must fit the description's plane by one homography. Corners come out with the centre
of the top-left pixel at (0.5, 0.5).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from devrf.capture.errors import CaptureError, HealthError, InputError
from devrf.capture.progress import Progress, no_progress

Auto = Literal["auto"] | bool
MIN_CORNERS = 6  # of a view that is used at all
TRIAL_VIEWS = 12  # views with markers that decide inverted, legacy and swapped
TRIAL_MARKERS = 4
FIT_SQUARES = 0.25  # a layout whose markers miss their places by more than this share of a square is wrong


@dataclass(frozen=True)
class BoardSpec:
    """What is printed.

    Attributes:
        type: `charuco` or `chessboard`.
        squares: Columns and rows: squares of a ChArUco board, inner corners of a chessboard.
        square_m, marker_m: Sides, metres.
        dictionary: OpenCV's name of the marker dictionary.
        inverted, legacy: Known, or "auto".
    """

    type: Literal["charuco", "chessboard"]
    squares: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_100"
    inverted: Auto = "auto"
    legacy: Auto = "auto"

    @property
    def corners(self) -> Float[np.ndarray, "corners 3"]:
        """Positions of the inner corners by id [N, 3], metres, z = 0."""
        columns, rows = self.squares if self.type == "chessboard" else (n - 1 for n in self.squares)
        offset = 0 if self.type == "chessboard" else 1
        grid = np.mgrid[0:rows, 0:columns][::-1].reshape(2, -1).T + offset
        return np.column_stack([grid * self.square_m, np.zeros(len(grid))])


@dataclass(frozen=True)
class BoardView:
    """The board in one picture.

    Attributes:
        frame: Position of the picture in the list that was searched.
        ids: Corner ids [n]; xy: where they are [n, 2], pixels.
    """

    frame: int
    ids: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]


def find_board(
    name: str,
    files: Sequence[Path],
    spec: BoardSpec,
    progress: Progress = no_progress,
    required: bool = True,
) -> tuple[list[BoardView], BoardSpec]:
    """Search pictures for the board.

    Args:
        name: Of the clip, for messages.
        files: Pictures.
        spec: Description; what is "auto" is settled first.
        progress: Called per picture.
        required: Whether to refuse a clip in which the board is never seen.
    Returns:
        A view for every picture with at least `MIN_CORNERS` corners, and the settled description.
    Raises:
        HealthError: The board is never seen, or what is seen does not fit the description.
    """
    settled = settle(name, files, spec, required)
    if settled is None:
        return [], spec
    detect = detector(settled)
    views = []
    for i, file in enumerate(files):
        ids, xy = detect(read_grey(file))
        if len(ids) >= MIN_CORNERS:
            views.append(BoardView(i, ids, xy))
        progress((i + 1) / len(files), f"board in {name}: {len(views)} of {i + 1} pictures")
    if not views and required:
        raise HealthError(_never_seen(name, len(files), settled))
    return views, settled


def settle(name: str, files: Sequence[Path], spec: BoardSpec, required: bool = True) -> BoardSpec | None:
    """Decide what is "auto" in the description, and whether columns and rows are swapped.

    Returns:
        The settled description; None where no marker is seen and that is allowed.
    Raises:
        InputError: No such dictionary.
        HealthError: No marker is seen in any picture, or the markers do not fit any layout.
    """
    if spec.type == "chessboard":
        return replace(spec, inverted=False, legacy=False)
    polarity, seen = _marker_trial(files, spec)
    if not seen:
        if not required:
            return None
        raise HealthError(_never_seen(name, len(files), spec))
    fits = []
    for squares in (spec.squares, spec.squares[::-1]):
        for legacy in (False, True) if spec.legacy == "auto" else (spec.legacy,):
            layout = replace(spec, squares=squares, inverted=polarity, legacy=legacy)
            fits.append((_layout_error(layout, seen), len(fits), layout))
    error, _, best = min(fits)
    if error > FIT_SQUARES:
        raise HealthError(
            f"{name}: markers of {spec.dictionary} are seen in {len(seen)} pictures but fit no "
            f"{spec.squares[0]}x{spec.squares[1]} layout (they miss by {error:.2f} squares); "
            "check squares, square_m, marker_m and dictionary of capture.board"
        )
    return best


def detector(
    spec: BoardSpec,
) -> Callable[[UInt8[np.ndarray, "h w"]], tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]]:
    """A function from a grey picture to (ids, corners) of a settled board; both empty where there is none."""
    if spec.type == "chessboard":
        return lambda grey: _chessboard(grey, spec)
    charuco = cv2.aruco.CharucoDetector(_charuco_board(spec))

    def detect(grey: UInt8[np.ndarray, "h w"]) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        corners, ids, _, _ = charuco.detectBoard(255 - grey if spec.inverted else grey)
        if ids is None or len(ids) == 0:
            return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
        return np.asarray(ids).reshape(-1).astype(np.int64), np.asarray(corners, np.float64).reshape(
            -1, 2
        ) + 0.5

    return detect


def read_grey(file: Path) -> UInt8[np.ndarray, "h w"]:
    """A picture as grey levels.

    Raises:
        CaptureError: It cannot be read.
    """
    grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise CaptureError(f"{file}: cannot be read as a picture; run again with --from ingest")
    return np.asarray(grey, dtype=np.uint8)


def _never_seen(name: str, count: int, spec: BoardSpec) -> str:
    kind = f"{spec.squares[0]}x{spec.squares[1]} {spec.type}"
    marks = f" with {spec.dictionary}" if spec.type == "charuco" else ""
    return (
        f"board never seen in {name}: 0 of {count} frames show a {kind}{marks}; check squares and dictionary "
        "of capture.board, and film the board larger than a quarter of the picture, sharp and without glare"
    )


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
        raise InputError(f"capture.board.dictionary: {name} is unknown; OpenCV has {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(number)


def _charuco_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    board = cv2.aruco.CharucoBoard(
        spec.squares, spec.square_m, spec.marker_m or 0.75 * spec.square_m, _dictionary(spec.dictionary)
    )
    board.setLegacyPattern(spec.legacy is True)
    return board


_Markers = tuple[Int[np.ndarray, " _"], Float[np.ndarray, "_ 4 2"]]


def _marker_trial(files: Sequence[Path], spec: BoardSpec) -> tuple[bool, list[_Markers]]:
    """Whether the print is inverted, and the markers of the first pictures that show some."""
    finder = cv2.aruco.ArucoDetector(_dictionary(spec.dictionary))
    count = spec.squares[0] * spec.squares[1] // 2 + 1
    polarities = (False, True) if spec.inverted == "auto" else (spec.inverted,)
    seen: dict[bool, list[_Markers]] = {p: [] for p in polarities}
    for file in _spread(files):
        grey = read_grey(file)
        for polarity in polarities:
            corners, ids, _ = finder.detectMarkers(255 - grey if polarity else grey)
            if ids is None:
                continue
            numbers = np.asarray(ids).reshape(-1)
            ours = numbers < count
            if ours.sum() >= TRIAL_MARKERS:
                quads = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
                seen[polarity].append((numbers[ours].astype(np.int64), quads[ours]))
        if max(len(s) for s in seen.values()) >= TRIAL_VIEWS:
            break
    best = max(polarities, key=lambda p: sum(len(ids) for ids, _ in seen[p]))
    return best, seen[best]


def _spread(files: Sequence[Path]) -> Iterable[Path]:
    """The files in an order that soon has looked everywhere: every 16th, then every 8th, ..."""
    done: set[int] = set()
    for step in (16, 8, 4, 2, 1):
        for i in range(0, len(files), step):
            if i not in done:
                done.add(i)
                yield files[i]


def _layout_error(layout: BoardSpec, seen: list[_Markers]) -> float:
    """Median over pictures of how far the markers lie from a homography of the layout, in squares."""
    board = _charuco_board(layout)
    place = dict(zip(np.asarray(board.getIds()).reshape(-1).tolist(), board.getObjPoints(), strict=True))
    errors = []
    for ids, quads in seen:
        pairs = [
            (np.asarray(place[i])[:, :2], quad)
            for i, quad in zip(ids.tolist(), quads, strict=True)
            if i in place
        ]
        if len(pairs) < TRIAL_MARKERS:
            continue
        on_board = np.concatenate([a for a, _ in pairs]).astype(np.float64)
        in_picture = np.concatenate([b for _, b in pairs])
        H, _ = cv2.findHomography(in_picture, on_board, cv2.LMEDS)
        if H is None:
            continue
        mapped = cv2.perspectiveTransform(in_picture[:, None], H)[:, 0]
        error = np.linalg.norm(mapped - on_board, axis=1) / layout.square_m
        errors.append(float(np.sqrt(np.minimum(error, 10.0) ** 2).mean()))
    return float(np.median(errors)) if errors else np.inf


def _chessboard(
    grey: UInt8[np.ndarray, "h w"], spec: BoardSpec
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, spec.squares, flags=flags)
    if not found:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 2))
    xy = np.asarray(corners, np.float64).reshape(-1, 2)
    if sum(spec.squares) % 2 == 1 and _first_square_is_light(grey, xy, spec):
        xy = xy[::-1].copy()  # half a turn: the detector may start at either end
    return np.arange(len(xy)), xy + 0.5


def _first_square_is_light(
    grey: UInt8[np.ndarray, "h w"], xy: Float[np.ndarray, "n 2"], spec: BoardSpec
) -> bool:
    """Whether the square between the first four corners is lighter than its neighbour in the row."""
    columns = spec.squares[0]
    if columns < 3:
        return False
    first = xy[[0, 1, columns, columns + 1]].mean(0)
    second = xy[[1, 2, columns + 1, columns + 2]].mean(0)
    (u0, v0), (u1, v1) = first.round().astype(int), second.round().astype(int)
    return bool(grey[v0, u0] > grey[v1, u1])
