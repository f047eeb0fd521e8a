"""How a board was printed, found out from pictures: inverted, legacy, columns and rows swapped, how it is numbered.

A wrong description still detects, with nonsense corners; what is right shows in the markers: their corners must
fit the description's plane by one homography. Chessboards have no markers: another size is tried where the
described one is never seen.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.boards.detect import detector
from devrf.calibration.boards.spec import (
    ORDERS,
    BoardSpec,
    dictionary,
    marker_count,
    marker_finder,
    marker_places,
)
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.errors import HealthError

TRIAL_VIEWS = 12  # views with markers that decide inverted, legacy and swapped
TRIAL_PICTURES = 8  # in which a chessboard of another size is looked for
TRIAL_MARKERS = 4
SEEN_TWICE = 2  # pictures; one alone is chance, or another thing with markers
MOST_FIRSTS = 64  # numbers of the first marker that are tried
BORDERS = {"charuco": (1,), "aruco_grid": (1, 2)}  # black cells around a code, by type of board
FIT_SQUARES = 0.25  # a layout whose markers miss their places by more than this share of a square is wrong


def settle(name: str, files: Sequence[Path], spec: BoardSpec, required: bool = True) -> BoardSpec | None:
    """Decide what is "auto" in the description of a board with markers, and whether the rest of it is right.

    What the description says is tried first, and kept where nothing speaks against it.

    Returns:
        The settled description; None where no marker of it is seen.
    Raises:
        InputError: No such dictionary.
        HealthError: The markers do not fit any layout.
    """
    printed, seen = _marker_trial(files, spec)
    if not seen:
        return None
    error, best = _best_layout(printed, seen)
    if error > FIT_SQUARES:
        error, best = _first_elsewhere(best, seen, error)
    ids = repeated_ids(seen)
    if error > FIT_SQUARES and not required and ids[0] >= marker_count(spec):
        return None  # markers of something else
    if error > FIT_SQUARES:
        which = f"{spec.dictionary} (ids from {ids[0]} to {ids[-1]})"
        seen_in = f"{name}: markers of {which} are seen in {len(seen)} pictures but fit no"
        misses = f"{spec.squares[0]}x{spec.squares[1]} layout (they miss by {error:.2f} squares)"
        remedy = "check squares, square_m, marker_m and dictionary of capture.board"
        if spec.type == "aruco_grid":
            remedy += " (markers that are not numbered row by row are not read)"
        raise HealthError("board-layout-wrong", f"{seen_in} {misses}; {remedy}")
    wrong = [("squares", f"[{best.squares[0]}, {best.squares[1]}]")] if best.squares != spec.squares else []
    for key in ("legacy", "inverted"):
        if getattr(spec, key) not in ("auto", getattr(best, key)):
            wrong.append((key, str(getattr(best, key)).lower()))
    return replace(best, corrections=tuple(wrong))


def chessboard_of_another_size(files: Sequence[Path], spec: BoardSpec) -> BoardSpec | None:
    """The chessboard that a few pictures show, where it is the described one turned, or counted in squares."""
    columns, rows = spec.squares
    sizes = [(rows, columns), (columns - 1, rows - 1), (rows - 1, columns - 1)]
    pictures = [read_grey(file) for _, file in zip(range(TRIAL_PICTURES), spread(files), strict=False)]
    for squares in dict.fromkeys(s for s in sizes if min(s) > 2 and s != spec.squares):
        other = replace(spec, squares=squares, corrections=(("squares", f"[{squares[0]}, {squares[1]}]"),))
        if any(len(detector(other)(grey)[0]) for grey in pictures):
            return other
    return None


def never_seen(name: str, count: int, spec: BoardSpec, instead: str) -> str:
    """A message; `instead` is what is seen in place of it."""
    what = "squares (inner corners, not fields)" if spec.type == "chessboard" else "squares and dictionary"
    but = f", but {instead}; describe what was printed" if instead else ""
    return (
        f"board never seen in {name}: 0 of {count} frames show a {spec.words}{but}; check {what} of capture.board, and "
        "film the board larger than a quarter of the picture, sharp and without glare"
    )


def spread(files: Sequence[Path]) -> Iterable[Path]:
    """The files in an order that soon has looked everywhere: every 16th, then every 8th, ..."""
    done: set[int] = set()
    for step in (16, 8, 4, 2, 1):
        for i in range(0, len(files), step):
            if i not in done:
                done.add(i)
                yield files[i]


def repeated_ids(seen: Sequence["Markers"]) -> list[int]:
    """Numbers of the markers that are seen more than once, rising: single misreadings have any."""
    counts = Counter(i for ids, _ in seen for i in ids.tolist())
    return sorted(i for i, n in counts.items() if n >= SEEN_TWICE or len(seen) < SEEN_TWICE) or sorted(counts)


Markers = tuple[Int[np.ndarray, " _"], Float[np.ndarray, "_ 4 2"]]


def _best_layout(spec: BoardSpec, seen: list[Markers]) -> tuple[float, BoardSpec]:
    """The layout that fits best, of both ways to count, patterns and orders, and by how much markers miss it."""
    fits = []
    for squares in (spec.squares, spec.squares[::-1]):
        for layout in variants(replace(spec, squares=squares), _tries(spec.legacy)):
            fits.append((layout_error(layout, seen), len(fits), layout))
    error, _, best = min(fits)
    return error, best


def _first_elsewhere(spec: BoardSpec, seen: list[Markers], error: float) -> tuple[float, BoardSpec]:
    """As `_best_layout`, for boards whose first marker is not number 0, where just one other first number fits."""
    ids = repeated_ids(seen)
    firsts = range(max(1, ids[-1] + 1 - marker_count(spec)), ids[0] + 1)
    if len(firsts) > MOST_FIRSTS:
        return error, spec
    found = [_best_layout(replace(spec, first_id=first), seen) for first in firsts]
    good = [fit for fit in found if fit[0] <= FIT_SQUARES]
    return good[0] if len(good) == 1 else (error, spec)


def variants(spec: BoardSpec, legacies: Sequence[bool]) -> list[BoardSpec]:
    """A board with markers in both patterns, or a grid in every order."""
    if spec.type == "charuco":
        return [replace(spec, legacy=legacy) for legacy in legacies]
    return [
        replace(spec, legacy=False, order=order) for order in sorted(ORDERS, key=lambda o: o != spec.order)
    ]


def covered(seen: Sequence[Markers]) -> float:
    """Square pixels that markers cover in all pictures: read with too thin a border, fewer and smaller ones are."""
    return sum((cv2.contourArea(quad.astype(np.float32)) for _, quads in seen for quad in quads), 0.0)


def _tries(told: object) -> tuple[bool, bool]:
    """What is told first, then the other."""
    return (True, False) if told is True else (False, True)


def _marker_trial(files: Sequence[Path], spec: BoardSpec) -> tuple[BoardSpec, list[Markers]]:
    """The board with `inverted` and `border` settled, and the markers of the first pictures that show some."""
    finders = {border: marker_finder(dictionary(spec.dictionary), border) for border in BORDERS[spec.type]}
    prints = [(polarity, border) for polarity in _tries(spec.inverted) for border in finders]
    seen: dict[tuple[bool, int], list[Markers]] = {p: [] for p in prints}
    for file in spread(files):
        grey = read_grey(file)
        for polarity, border in prints:
            corners, ids, _ = finders[border].detectMarkers(255 - grey if polarity else grey)
            if ids is None:
                continue
            numbers = np.asarray(ids).reshape(-1)
            if len(numbers) >= TRIAL_MARKERS:
                quads = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
                seen[polarity, border].append((numbers.astype(np.int64), quads))
        if max(len(s) for s in seen.values()) >= TRIAL_VIEWS:
            break
    best = max(prints, key=lambda p: covered(seen[p]))
    return replace(spec, inverted=best[0], border=best[1]), seen[best]


def layout_error(layout: BoardSpec, seen: list[Markers]) -> float:
    """Median over pictures of how far the markers lie from a homography of the layout, in squares."""
    place = marker_places(layout)
    errors = []
    for ids, quads in seen:
        pairs = [(place[i], quad) for i, quad in zip(ids.tolist(), quads, strict=True) if i in place]
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
