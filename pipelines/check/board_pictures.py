"""The calibration board in `check`: is it seen in the clips that were filmed for it, by the search that `rig` makes."""

import tempfile
from pathlib import Path

import cv2

from devrf.calibration.boards.find import find_board
from devrf.calibration.boards.spec import BoardSpec
from devrf.capture.frames import SWEEP
from devrf.capture.ingest.survey import look_at
from devrf.capture.measure import Measure
from devrf.capture.session import CaptureSession
from devrf.capture.system.errors import HealthError
from devrf.capture.system.progress import Progress

PICTURES = 8  # of each clip


def board_measures(session: CaptureSession, spec: BoardSpec, progress: Progress) -> list[Measure]:
    """Of each clip with the board before one camera, or before several at once, the share that shows it."""
    clips = [(name, path, False) for name, path in session.board_clips.items()]
    clips += [(name, path, True) for name, path in session.joint_clips.items()]
    found = []
    for n, (name, path, joint) in enumerate(clips):
        progress(n / len(clips), f"board of {name}")
        found.append(_seen(name, path, spec, joint))
    return found


def _seen(name: str, path: Path, spec: BoardSpec, joint: bool) -> Measure:
    whose = "the sweep's camera" if name == SWEEP else name
    greys = look_at(path, PICTURES).greys
    with tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / f"{n}.png" for n in range(len(greys))]
        for file, grey in zip(files, greys, strict=True):
            cv2.imwrite(str(file), grey)
        try:
            views, _ = find_board(f"the board clip of {whose}", files, spec)
        except HealthError as error:
            # Several cameras may see it for a moment only, between the pictures that are looked at.
            facts = {"error": str(error)}
            return Measure("board-unseen", "never", whose, "never", facts, "warn" if joint else "fail")
    if joint:
        return Measure("board-unseen", f"{len(views)} of {len(greys)} pictures show it", whose, found="ok")
    return Measure("board-unseen", len(views) / len(greys), whose)
