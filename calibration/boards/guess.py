"""Which calibration board do pictures show? Dictionary, columns and rows; the size of a square nobody can see.

Markers of every dictionary of OpenCV are looked for, dark on light and light on dark. Where they sit tells the layout:
each that could hold the ids that were seen is laid under the markers by a homography. Without markers a chessboard of
any size is looked for.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from devrf.calibration.boards.detect import MIN_CORNERS, detector
from devrf.calibration.boards.layout import (
    FIT_SQUARES,
    SEEN_TWICE,
    TRIAL_MARKERS,
    Markers,
    layout_error,
    repeated_ids,
)
from devrf.calibration.boards.spec import BoardSpec, dictionary, marker_places

Grey = UInt8[np.ndarray, "_ _"]  # pictures of different cameras have different sizes

FAMILIES = (  # larger dictionaries of a family begin with the smaller ones
    *((f"DICT_{n}X{n}_50", f"DICT_{n}X{n}_100", f"DICT_{n}X{n}_250", f"DICT_{n}X{n}_1000") for n in (4, 5, 6, 7)),
    ("DICT_APRILTAG_16h5",),
    ("DICT_APRILTAG_25h9",),
    ("DICT_APRILTAG_36h10",),
    ("DICT_APRILTAG_36h11",),
    ("DICT_ARUCO_MIP_36h12",),
    ("DICT_ARUCO_ORIGINAL",),
)  # fmt: skip
ENOUGH_VIEWS = 8  # pictures with markers that settle a layout
LARGEST_SIDE = 24  # squares; larger boards have markers too small for most clips
CHESSBOARD_FROM = (5, 4)  # inner corners; smaller ones are seen in tiles and windows
CHESSBOARD_FLAGS = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE


@dataclass(frozen=True)
class BoardGuess:
    """A board as far as pictures show it.

    Attributes:
        spec: Its layout with squares of length 1; `marker_m` is then the marker's share of a square.
        ids: Largest marker id that was seen, -1 for a chessboard.
    """

    spec: BoardSpec
    largest_id: int


def guess_board(greys: Sequence[Grey]) -> BoardGuess | None:
    """The board that most of the pictures show; None where none is seen at least twice."""
    for inverted in (False, True):
        found = _guess_markers([255 - grey if inverted else grey for grey in greys])
        if found is not None:
            guess = replace(found, spec=replace(found.spec, inverted=inverted))
            return guess if _is_found(guess.spec, greys) else None
    return _guess_chessboard(greys)


def board_pictures(greys: Sequence[Grey], guess: BoardGuess) -> int:
    """In how many pictures the board is seen."""
    spec = guess.spec
    if spec.type == "chessboard":
        return sum(chessboard_size(grey) == spec.squares for grey in greys)
    finder = cv2.aruco.ArucoDetector(dictionary(spec.dictionary))
    count = 0
    for grey in greys:
        _, ids, _ = finder.detectMarkers(255 - grey if spec.inverted is True else grey)
        if ids is not None:
            numbers = np.asarray(ids)
            ours = (numbers >= spec.first_id) & (numbers <= guess.largest_id)
            count += int(ours.sum() >= TRIAL_MARKERS)
    return count


def _guess_markers(greys: Sequence[Grey]) -> BoardGuess | None:
    seen: dict[int, list[Markers]] = {n: [] for n in range(len(FAMILIES))}
    searched = list(seen)
    finder = cv2.aruco.ArucoDetector([dictionary(FAMILIES[n][-1]) for n in searched])
    for grey in greys:
        corners, ids, _, which = finder.detectMarkersMultiDict(grey)
        if ids is None or which is None:
            continue
        quads = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
        numbers, owner = np.asarray(ids).reshape(-1).astype(np.int64), np.asarray(which).reshape(-1)
        for k, n in enumerate(searched):
            mine = owner == k
            if mine.sum() >= TRIAL_MARKERS:
                seen[n].append((numbers[mine], quads[mine]))
        views = {n: len(seen[n]) for n in searched}
        if max(views.values()) >= ENOUGH_VIEWS:
            break
        # all dictionaries take a second a picture
        if len(searched) > 1 and max(views.values()) >= SEEN_TWICE:
            searched = [max(searched, key=lambda n: sum(len(ids) for ids, _ in seen[n]))]
            finder = cv2.aruco.ArucoDetector([dictionary(FAMILIES[searched[0]][-1])])
    best = max(seen, key=lambda n: sum(len(ids) for ids, _ in seen[n]))
    if len(seen[best]) < SEEN_TWICE:
        return None
    guess = _layout(FAMILIES[best], seen[best])
    if guess is None:
        return None
    return replace(guess, spec=replace(guess.spec, marker_m=_marker_share(guess.spec, greys)))


def _layout(family: Sequence[str], seen: list[Markers]) -> BoardGuess | None:
    """Kind, columns and rows that put the markers where they are seen."""
    ids = repeated_ids(seen)
    largest = ids[-1]
    name = next((n for n in family if dictionary(n).bytesList.shape[0] > largest), family[-1])
    found = [_best_from(first, name, largest, seen) for first in sorted({0, ids[0]})]
    error, _, best = min(found, key=lambda fit: (fit[0] > FIT_SQUARES, fit[2].first_id, fit[0]))
    return BoardGuess(best, largest) if error <= FIT_SQUARES else None


def _best_from(first: int, name: str, largest: int, seen: list[Markers]) -> tuple[float, int, BoardSpec]:
    """The layout with a first marker of this number that fits best: how far markers miss it, its place, and itself."""
    guesses = []
    for kind in ("charuco", "aruco_grid"):
        for columns in range(2, LARGEST_SIDE + 1):
            markers_per_two_rows = columns if kind == "charuco" else 2 * columns
            rows = max(2, int(np.ceil(2 * (largest + 1 - first) / markers_per_two_rows)))
            if rows > LARGEST_SIDE:
                continue
            for legacy in (False, True) if kind == "charuco" and rows % 2 == 0 else (False,):
                spec = BoardSpec(kind, (columns, rows), 1.0, 0.75, name, False, legacy, first)
                guesses.append((layout_error(spec, seen), len(guesses), spec))
    return min(guesses)


def _marker_share(spec: BoardSpec, greys: Sequence[Grey]) -> float:
    """Side of a marker over that of a square: centres of markers do not depend on it, and give the plane."""
    refined = cv2.aruco.DetectorParameters()
    # else markers come out half a pixel too small
    refined.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    finder = cv2.aruco.ArucoDetector(dictionary(spec.dictionary), refined)
    centres = {i: corners.mean(0) for i, corners in marker_places(spec).items()}
    sides: list[float] = []
    for grey in greys:
        corners, ids, _ = finder.detectMarkers(grey)
        if ids is None:
            continue
        numbers = np.asarray(ids).reshape(-1).tolist()
        quads = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)[[i in centres for i in numbers]]
        if len(quads) < TRIAL_MARKERS:
            continue
        on_board = np.array([centres[i] for i in numbers if i in centres])
        H, _ = cv2.findHomography(quads.mean(1), on_board, cv2.RANSAC, FIT_SQUARES)
        if H is not None:
            mapped = cv2.perspectiveTransform(quads.reshape(-1, 1, 2), H).reshape(-1, 4, 2)
            sides += np.linalg.norm(mapped - np.roll(mapped, 1, axis=1), axis=2).ravel().tolist()
    return float(np.clip(np.median(sides), 0.1, 0.95)) if sides else spec.marker_m or 0.75


def _is_found(spec: BoardSpec, greys: Sequence[Grey]) -> bool:
    """Whether a run would find the board too: its corners, in at least one picture."""
    detect = detector(spec)
    return any(len(detect(grey)[0]) >= MIN_CORNERS for grey in greys)


def _guess_chessboard(greys: Sequence[Grey]) -> BoardGuess | None:
    sizes = Counter(size for grey in greys if (size := chessboard_size(grey)) is not None)
    if not sizes:
        return None
    size, count = max(sizes.items(), key=lambda item: (item[1], item[0][0] * item[0][1]))
    if count < max(SEEN_TWICE, sum(sizes.values()) / 2):  # parts of a pattern change from picture to picture
        return None
    return BoardGuess(BoardSpec("chessboard", size, 1.0, inverted=False, legacy=False), -1)


def chessboard_size(grey: Grey) -> tuple[int, int] | None:
    """Inner corners of the chessboard in a picture, the longer side first; None where none is seen."""
    cv2.setRNGSeed(0)
    found, _, meta = cv2.findChessboardCornersSBWithMeta(grey, CHESSBOARD_FROM, CHESSBOARD_FLAGS)
    if not found or meta is None:
        return None
    rows, columns = sorted(np.asarray(meta).shape[:2])
    return columns, rows
