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

from devrf.calibration.boards.detect import MARKER_WINDOW, MIN_CORNERS, detector, refined
from devrf.calibration.boards.layout import (
    FIT_SQUARES,
    SEEN_TWICE,
    TRIAL_MARKERS,
    Markers,
    covered,
    layout_error,
    repeated_ids,
    variants,
)
from devrf.calibration.boards.spec import BoardSpec, dictionary, marker_finder, marker_places

Grey = UInt8[np.ndarray, "_ _"]  # pictures of different cameras have different sizes

Family = tuple[str, ...]
APRILTAGS: tuple[Family, ...] = (("DICT_APRILTAG_16h5",), ("DICT_APRILTAG_25h9",), ("DICT_APRILTAG_36h11",))
FAMILIES: tuple[Family, ...] = (  # larger dictionaries of a family begin with the smaller ones
    *((f"DICT_{n}X{n}_50", f"DICT_{n}X{n}_100", f"DICT_{n}X{n}_250", f"DICT_{n}X{n}_1000") for n in (4, 5, 6, 7)),
    *APRILTAGS,
    ("DICT_APRILTAG_36h10",),
    ("DICT_ARUCO_MIP_36h12",),
    ("DICT_ARUCO_ORIGINAL",),
)  # fmt: skip
OF_BORDER = {1: FAMILIES, 2: APRILTAGS}  # Kalibr prints AprilTags with a border of two cells
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
    """The board that most of the pictures show; None where none is seen at least twice, or only mirrored."""
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
    finder = marker_finder(dictionary(spec.dictionary), spec.border)
    count = 0
    for grey in greys:
        _, ids, _ = finder.detectMarkers(255 - grey if spec.inverted is True else grey)
        if ids is not None:
            numbers = np.asarray(ids)
            ours = (numbers >= spec.first_id) & (numbers <= guess.largest_id)
            count += int(ours.sum() >= TRIAL_MARKERS)
    return count


def _guess_markers(greys: Sequence[Grey]) -> BoardGuess | None:
    looks = [(*_most_seen(greys, border), border) for border in OF_BORDER]
    family, seen, border = max(looks, key=lambda look: covered(look[1]))
    guess = _layout(family, seen, border) if len(seen) >= SEEN_TWICE else None
    if guess is None:
        return None
    return replace(guess, spec=replace(guess.spec, marker_m=_marker_share(guess.spec, greys)))


def _most_seen(greys: Sequence[Grey], border: int) -> tuple[Family, list[Markers]]:
    """The family of which most markers with such a border are seen, and these."""
    families = OF_BORDER[border]
    seen: dict[int, list[Markers]] = {n: [] for n in range(len(families))}
    searched = list(seen)
    finder = marker_finder([dictionary(families[n][-1]) for n in searched], border)
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
            finder = marker_finder([dictionary(families[searched[0]][-1])], border)
    best = max(seen, key=lambda n: sum(len(ids) for ids, _ in seen[n]))
    return families[best], seen[best]


def _layout(family: Family, seen: list[Markers], border: int) -> BoardGuess | None:
    """Kind, columns and rows that put the markers where they are seen."""
    ids = repeated_ids(seen)
    largest = ids[-1]
    name = next((n for n in family if dictionary(n).bytesList.shape[0] > largest), family[-1])
    found = [_best_from(first, name, largest, seen, border) for first in sorted({0, ids[0]})]
    error, _, best = min(found, key=lambda fit: (fit[0] > FIT_SQUARES, fit[2].first_id, fit[0]))
    return BoardGuess(best, largest) if error <= FIT_SQUARES else None


def _best_from(
    first: int, name: str, largest: int, seen: list[Markers], border: int
) -> tuple[float, int, BoardSpec]:
    """The layout with a first marker of this number that fits best: how far markers miss it, its place, and itself."""
    guesses = []
    for kind in ("charuco", "aruco_grid") if border == 1 else ("aruco_grid",):
        for columns in range(2, LARGEST_SIDE + 1):
            markers_per_two_rows = columns if kind == "charuco" else 2 * columns
            rows = max(2, int(np.ceil(2 * (largest + 1 - first) / markers_per_two_rows)))
            if rows > LARGEST_SIDE:
                continue
            legacies = (False, True) if rows % 2 == 0 else (False,)
            one = BoardSpec(kind, (columns, rows), 1.0, 0.75, name, False, first_id=first, border=border)
            for spec in variants(one, legacies):
                guesses.append((layout_error(spec, seen), len(guesses), spec))
    return min(guesses)


def _marker_share(spec: BoardSpec, greys: Sequence[Grey]) -> float:
    """Side of a marker over that of a square: centres of markers do not depend on it, and give the plane."""
    finder = marker_finder(dictionary(spec.dictionary), spec.border)
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
        side_px = float(np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min())
        quads = refined(grey, quads.reshape(-1, 2), MARKER_WINDOW[spec.border] * side_px).reshape(-1, 4, 2)
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
    shown = {n: size for n, grey in enumerate(greys) if (size := chessboard_size(grey)) is not None}
    sizes = Counter(shown.values())
    if not sizes:
        return None
    mirrored = [np.ascontiguousarray(greys[n][:, ::-1]) for n in list(shown)[:SEEN_TWICE]]
    if _most_seen(mirrored, 1)[1]:  # squares of a board with markers look alike in a mirror, markers do not
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
