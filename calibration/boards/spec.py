"""What is printed on a calibration board, and where its corners are; a view of it in a picture."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from jaxtyping import Float, Int

from devrf.capture.system.errors import InputError

Auto = Literal["auto"] | bool
BoardType = Literal["charuco", "chessboard", "aruco_grid"]
Order = Literal["down", "up", "kalibr"]
"""How the markers of a grid are numbered, row by row: from the top left as OpenCV does, from the bottom left, or from
the bottom left with every marker upside down, as Kalibr prints its aprilgrid."""
ORDERS: tuple[Order, ...] = get_args(Order)


@dataclass(frozen=True)
class BoardSpec:
    """What is printed.

    Attributes:
        type: `charuco`, `chessboard` or `aruco_grid` (OpenCV's GridBoard, Kalibr's aprilgrid).
        squares: Columns and rows: squares of a ChArUco board, inner corners of a chessboard, markers of a grid.
        square_m: Side of a square; of a grid, from one marker's edge to the next marker's same edge. Metres.
        marker_m: Side of a marker, metres.
        dictionary: OpenCV's name of the marker dictionary.
        inverted, legacy: Known, or "auto".
        first_id, order: Number of the first marker, and where in a grid it is; found by `find_board`.
        border: Black cells around a marker's code; Kalibr's markers have 2. Found by `find_board`.
        corrections: Key and value of what pictures show otherwise than was told; filled by `find_board`.
    """

    type: BoardType
    squares: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_100"
    inverted: Auto = "auto"
    legacy: Auto = "auto"
    first_id: int = 0
    order: Order = "down"
    border: int = 1
    corrections: tuple[tuple[str, str], ...] = ()

    @property
    def corners(self) -> Float[np.ndarray, "corners 3"]:
        """Positions of the corners by id [N, 3], metres, z = 0: inner corners, or four of each marker in turn."""
        columns, rows = self.squares if self.type != "charuco" else (n - 1 for n in self.squares)
        grid = np.mgrid[0:rows, 0:columns][::-1] * self.square_m
        grid = (grid if self.order == "down" else grid[:, ::-1]).reshape(2, -1).T
        if self.type == "charuco":
            grid = grid + self.square_m
        elif self.type == "aruco_grid":
            around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (self.marker_m or 0.0)
            around = around if self.order != "kalibr" else np.roll(around, 2, axis=0)
            grid = (grid[:, None] + around).reshape(-1, 2)
        return np.column_stack([grid, np.zeros(len(grid))])

    @property
    def edges(self) -> Int[np.ndarray, "edges 2"]:
        """Pairs of corner ids with a black and white edge between them, one square or marker long."""
        if self.type == "aruco_grid":
            first = 4 * np.arange(self.squares[0] * self.squares[1])
            return np.concatenate([np.stack([first + a, first + (a + 1) % 4], axis=1) for a in range(4)])
        columns, rows = self.squares if self.type == "chessboard" else (n - 1 for n in self.squares)
        ids = np.arange(columns * rows).reshape(rows, columns)
        across = np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)
        return np.concatenate([across, np.stack([ids[:-1], ids[1:]], axis=-1).reshape(-1, 2)])

    @property
    def words(self) -> str:
        """For messages."""
        marks = "" if self.type == "chessboard" else f" with {self.dictionary}"
        first = f", markers from number {self.first_id} on"
        found = (
            (self.legacy is True, ", legacy layout"),
            (self.inverted is True, ", white on black"),
            (self.first_id > 0, first),
            (self.order != "down", ", numbered from the bottom"),
        )
        return f"{self.squares[0]}x{self.squares[1]} {self.type}{marks}" + "".join(
            t for yes, t in found if yes
        )


@dataclass(frozen=True)
class BoardView:
    """The board in one picture.

    Attributes:
        frame: Position of the picture in the list that was searched.
        ids: Corner ids [n]; xy: where they are [n, 2], pixels.
        blur: Width of the edges between corners, in sides of a square; blur_px: in pixels. NaN where not measured.
    """

    frame: int
    ids: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    blur: float = np.nan
    blur_px: float = np.nan


def dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's marker dictionary of that name.

    Raises:
        InputError: There is none.
    """
    number = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(number, int):
        known = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
        near = difflib.get_close_matches(name, known, n=3, cutoff=0.0)
        text = f"capture.board.dictionary: OpenCV has no dictionary {name}; did you mean {', '.join(near)}?"
        raise InputError("board-dictionary-unknown", text)
    return cv2.aruco.getPredefinedDictionary(number)


def marker_finder(
    dictionaries: cv2.aruco.Dictionary | Sequence[cv2.aruco.Dictionary], border: int
) -> cv2.aruco.ArucoDetector:
    """OpenCV's detector of markers with so many black cells around the code."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = border
    return cv2.aruco.ArucoDetector(dictionaries, options)


def marker_count(spec: BoardSpec) -> int:
    """How many markers are on a board with markers."""
    columns, rows = spec.squares
    return columns * rows if spec.type == "aruco_grid" else columns * rows // 2


def charuco_board(spec: BoardSpec) -> cv2.aruco.CharucoBoard:
    """A settled ChArUco board as OpenCV has it."""
    ids = spec.first_id + np.arange(marker_count(spec), dtype=np.int32)
    board = cv2.aruco.CharucoBoard(
        spec.squares, spec.square_m, spec.marker_m or 0.75 * spec.square_m, dictionary(spec.dictionary), ids
    )
    board.setLegacyPattern(spec.legacy is True)
    return board


def marker_places(spec: BoardSpec) -> dict[int, Float[np.ndarray, "4 2"]]:
    """Marker id -> its corners on a settled board with markers, metres."""
    if spec.type == "aruco_grid":
        return dict(enumerate(spec.corners[:, :2].reshape(-1, 4, 2), spec.first_id))
    board = charuco_board(spec)
    ids = np.asarray(board.getIds()).reshape(-1).tolist()
    return {i: np.asarray(p, dtype=np.float64)[:, :2] for i, p in zip(ids, board.getObjPoints(), strict=True)}
