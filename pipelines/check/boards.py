"""The calibration board in `check`: is it seen in the clips that were filmed for it, by the search that `rig` makes."""

import tempfile
from pathlib import Path

import cv2

from devrf.calibration.boards.find import find_board
from devrf.calibration.boards.spec import BoardSpec
from devrf.capture.errors import HealthError
from devrf.capture.frames import SWEEP
from devrf.capture.progress import Progress
from devrf.capture.session import CaptureSession
from devrf.capture.survey import look_at
from devrf.pipelines.health.rows import HealthRow, note, row

PICTURES = 8  # of each clip
SEEN_WARN = 0.3  # of a clip filmed for the board; sooner or later a hand, an edge or blur hides it
REMEDY = "Film the board larger than a quarter of the picture, sharp, without glare, tilted to all sides."


def board_rows(session: CaptureSession, spec: BoardSpec, progress: Progress) -> list[HealthRow]:
    """A row for each clip with the board before one camera, or before several at once."""
    clips = [(name, path, False) for name, path in session.board_clips.items()]
    clips += [(name, path, True) for name, path in session.joint_clips.items()]
    rows = []
    for n, (name, path, joint) in enumerate(clips):
        progress(n / len(clips), f"board of {name}")
        rows.append(_row(name, path, spec, joint))
    return rows


def _row(name: str, path: Path, spec: BoardSpec, joint: bool) -> HealthRow:
    whose = "the sweep's camera" if name == SWEEP else name
    check = f"share of the {'joint ' if joint else ''}board clip of {whose} in which the board is seen"
    greys = look_at(path, PICTURES).greys
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{n}.png" for n in range(len(greys))]
        for file, grey in zip(files, greys, strict=True):
            cv2.imwrite(str(file), grey)
        try:
            views, _ = find_board(f"the board clip of {whose}", files, spec)
        except HealthError as error:
            # Several cameras may see it for a moment only, between the pictures that are looked at.
            return note(check, "never", verdict="warn" if joint else "fail", remedy=f"{error}.")
    return row(check, len(views) / len(greys), warn=None if joint else SEEN_WARN, remedy=REMEDY)
