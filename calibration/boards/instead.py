"""What pictures show where the described board is never found: other markers, mirrored ones, a chessboard."""

from collections.abc import Sequence

import numpy as np

from devrf.calibration.boards.guess import OF_BORDER, Grey, chessboard_size
from devrf.calibration.boards.layout import TRIAL_MARKERS
from devrf.calibration.boards.spec import dictionary, marker_finder

PICTURES = 4  # all dictionaries take a second in each
LOOKS = (  # mirrored, white on black, cells of border
    (False, False, 1), (False, False, 2), (False, True, 1), (True, False, 1), (True, True, 1),
)  # fmt: skip
MIRRORED = (
    ", in mirrored pictures: switch the camera's mirroring off, or film the board with the camera as it is"
)


def seen_instead(greys: Sequence[Grey]) -> str:
    """What a few pictures show, in words; empty where it is nothing that is known."""
    for mirrored, inverted, border in LOOKS:
        turned = [grey[:, ::-1] if mirrored else grey for grey in greys]
        found = _markers([np.ascontiguousarray(255 - g if inverted else g) for g in turned], border)
        if found is not None:
            name, ids = found
            count = f"{len(ids)} markers of {name}, ids from {min(ids)} to {max(ids)}"
            return f"{count}{', white on black' if inverted else ''}{MIRRORED if mirrored else ''}"
    sizes = {size for grey in greys if (size := chessboard_size(grey)) is not None}
    return " or ".join(f"a chessboard of {columns}x{rows} inner corners" for columns, rows in sorted(sizes))


def _markers(greys: Sequence[Grey], border: int) -> tuple[str, set[int]] | None:
    """The dictionary of which most markers are seen in one picture or more, and their numbers."""
    families = OF_BORDER[border]
    finder = marker_finder([dictionary(family[-1]) for family in families], border)
    seen: dict[int, set[int]] = {}
    for grey in greys:
        _, ids, _, which = finder.detectMarkersMultiDict(grey)
        if ids is None or which is None:
            continue
        numbers, owner = np.asarray(ids).reshape(-1), np.asarray(which).reshape(-1)
        for n in np.unique(owner).tolist():
            own = numbers[owner == n].tolist()
            if len(set(own)) >= TRIAL_MARKERS:
                seen.setdefault(n, set()).update(own)
    if not seen:
        return None
    best = max(seen, key=lambda n: len(seen[n]))
    name = next(n for n in families[best] if dictionary(n).bytesList.shape[0] > max(seen[best]))
    return name, seen[best]
