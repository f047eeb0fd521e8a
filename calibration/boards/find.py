"""Calibration boards in the pictures of a clip: ChArUco, chessboard and grids of markers, however they were printed."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

from devrf.calibration.boards.detect import detector, edge_width, fixes_pose
from devrf.calibration.boards.instead import PICTURES, seen_instead
from devrf.calibration.boards.layout import chessboard_of_another_size, never_seen, settle, spread
from devrf.calibration.boards.spec import BoardSpec, BoardView
from devrf.capture.photos.upright_pictures import read_grey
from devrf.capture.system.errors import HealthError
from devrf.capture.system.progress import Progress, no_progress

ENOUGH_VIEWS = 20  # of a chessboard; up to here pictures in which it was not found are searched once more


def find_board(
    name: str, files: Sequence[Path], spec: BoardSpec, progress: Progress = no_progress, required: bool = True
) -> tuple[list[BoardView], BoardSpec]:
    """Search pictures for the board.

    Args:
        name: Of the clip, for messages.
        files: Pictures.
        spec: Description; what is "auto" is settled first.
        progress: Called per picture.
        required: Whether to refuse a clip in which the board is never seen.
    Returns:
        A view for every picture whose corners fix a pose, and the settled description.
    Raises:
        HealthError: The board is never seen, or what is seen does not fit the description.
    """
    if spec.type == "chessboard":
        settled = replace(spec, inverted=False, legacy=False)
    elif (found := settle(name, files, spec, required)) is not None:
        settled = found
    elif required:
        raise HealthError("board-never-seen", never_seen(name, len(files), spec, _instead(files)))
    else:
        return [], spec
    views = _search(name, files, settled, progress)
    if not views and spec.type == "chessboard" and required:
        other = chessboard_of_another_size(files, settled)
        if other is not None:
            settled, views = other, _search(name, files, other, progress)
    if not views and required:
        raise HealthError("board-never-seen", never_seen(name, len(files), settled, _instead(files)))
    return views, settled


def _instead(files: Sequence[Path]) -> str:
    return seen_instead([read_grey(file) for file in islice(spread(files), PICTURES)])


def _search(name: str, files: Sequence[Path], spec: BoardSpec, progress: Progress) -> list[BoardView]:
    views: dict[int, BoardView] = {}
    for second_try in (False, True) if spec.type == "chessboard" else (False,):
        detect = detector(spec, second_try)
        for i, file in enumerate(files):
            if i in views or (second_try and len(views) >= ENOUGH_VIEWS):
                continue
            grey = read_grey(file)
            ids, xy = detect(grey)
            if fixes_pose(spec, ids):
                views[i] = BoardView(i, ids, xy, *edge_width(grey, spec, ids, xy))
            progress((i + 1) / len(files), f"board in {name}: {len(views)} of {i + 1} pictures")
    return [views[i] for i in sorted(views)]
