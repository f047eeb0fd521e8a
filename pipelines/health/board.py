"""Health rows about one camera's board calibration, for the stages that make one."""

from devrf.calibration.boards.calibrate import BoardCalibration
from devrf.pipelines.health.rows import HealthRow, note, row

LISTED = 6  # frames in a message
MISREAD = 10.0  # times the median error: such a view was not a bad one, but misread
BOW_SHARE = 0.003  # of the board's longer side: 1 mm of 33 cm, which moves the focal length by some tenths of a percent
HELD_OUT_GAIN = 1.5  # held-out views may be that much worse; their poses alone were fitted


def board_rows(name: str, board: BoardCalibration) -> list[HealthRow]:
    """Rows about one camera's board calibration."""
    rows = [
        _print_row(name, board),
        row(
            f"board error of {name}",
            board.rms_px,
            "px",
            warn_above=1.0,
            fail_above=3.0,
            remedy="The board does not fit: check squares, use a flat print, avoid motion blur."
            + _list(" Dropped views", board.dropped),
        ),
        row(
            f"board views of {name}",
            float(board.views),
            warn=10.0,
            remedy=f"Few views leave the principal point unsure ({_centre_doubt(board)}): film the board longer."
            + _list(" Dropped views", board.dropped),
        ),
        row(
            f"directions in which the board was tilted before {name}",
            float(board.evidence.tilt_sectors),
            "of 8",
            warn=4.0,
            remedy="Frontal views leave the focal length unsure: tilt the board by 20 to 45 degrees, "
            "left and right, up and down.",
        ),
        *_coverage_rows(name, board),
        row(
            f"focal length of {name} by the board, standard deviation",
            _focal_std(board),
            "%",
            warn_above=0.5,
            remedy="The views leave the focal length unsure: film more of them, the board large in the "
            "picture and tilted by 20 to 45 degrees.",
        ),
        _view_row(name, board),
        note(f"lens of {name} by the board", _lens_words(board)),
    ]
    if board.held_out_rms_px is not None:
        rows.append(
            row(
                f"board error of {name} on views held out",
                board.held_out_rms_px,
                "px",
                warn_above=max(1.0, HELD_OUT_GAIN * board.rms_px),
                remedy="Views that were not fitted agree less: the lens is unsure where they lie. Film the "
                "board more evenly over the picture, with focus and zoom locked.",
            )
        )
    return rows + _bow_rows(name, board)


def _print_row(name: str, board: BoardCalibration) -> HealthRow:
    found = board.board
    wrong = ", ".join(f"{key}: {value}" for key, value in found.corrections)
    remedy = (
        f"The board is not as described; write {wrong} in capture.board. What the pictures show was used."
    )
    return note(f"board before {name}", found.words, remedy=remedy if wrong else "")


def _coverage_rows(name: str, board: BoardCalibration) -> list[HealthRow]:
    evidence = board.evidence
    unseen = ", ".join(evidence.unseen)
    remedy = "Distortion there is a guess: hold the board into every corner of the picture."
    never = f" Never seen: {unseen}." if unseen else ""
    rows = [
        row(
            f"picture covered by board corners, {name}",
            evidence.coverage,
            warn=0.8,
            remedy=f"{remedy}{never}",
        )
    ]
    if unseen and rows[0].verdict == "ok":
        corners = sum("corner" in place for place in evidence.unseen)
        remedy = remedy + never if corners > 2 else ""
        rows.append(note(f"never seen with the board, {name}", unseen, remedy=remedy))
    return rows


def _view_row(name: str, board: BoardCalibration) -> HealthRow:
    """Which views were left out, and why."""
    blurred = list(board.blurred)
    said = [
        *([f"blurred {_some(blurred)}"] if blurred else []),
        *([f"do not fit {_errors(board)}"] if board.dropped else []),
    ]
    all_views = board.views + len(blurred) + len(board.dropped)
    misread = [e for e in board.dropped.values() if e > MISREAD * board.rms_px]
    remedy = ""
    if len(blurred) > all_views / 4:
        remedy = f"{len(blurred)} of {all_views} views of the board are blurred: move it slowly, rest it, add light."
    elif misread:
        remedy = "Corners were misread, and the views dropped: hide nothing of the board, avoid glare and reflections."
    elif len(board.dropped) > all_views / 4:
        remedy = "Many views do not fit: lock focus and zoom, hold the board still and flat."
    words = "; ".join(said) or "none"
    return note(f"board views of {name} left out", words, remedy=remedy)


def _lens_words(board: BoardCalibration) -> str:
    words = board.terms.words
    if board.unsupported:
        words += f"; not supported by the views: {board.unsupported}"
    if board.second_start_better:
        first, second = board.start_rms_px
        words += f"; second start better: {second:.2f} against {first:.2f} px"
    return words


def _bow_rows(name: str, board: BoardCalibration) -> list[HealthRow]:
    along = max(range(2), key=lambda axis: abs(board.bow_mm[axis]))
    bow = board.bow_mm[along]
    if bow == 0.0:
        return []
    corners = board.board.corners
    side_mm = 1e3 * float((corners.max(0) - corners.min(0)).max())
    return [
        row(
            f"bow of the board before {name}",
            abs(bow),
            "mm",
            warn_above=BOW_SHARE * side_mm,
            remedy=f"The board bows by {abs(bow):.1f} +- {board.bow_std_mm[along]:.1f} mm; it was corrected for here, "
            "but glue the print onto a rigid, flat plate.",
        )
    ]


def _focal_std(board: BoardCalibration) -> float | None:
    k = board.intrinsics
    return None if k.std is None else 100 * float(k.std[0] / k.K[0, 0])


def _centre_doubt(board: BoardCalibration) -> str:
    std = board.intrinsics.std
    return "unknown" if std is None else f"+- {max(std[2], std[3]):.1f} px"


def _errors(board: BoardCalibration) -> str:
    return _some([f"{frame} ({error:.1f} px)" for frame, error in board.dropped.items()])


def _list(title: str, frames: dict[int, float]) -> str:
    return f"{title}: {_some(list(frames))}." if frames else ""


def _some(things: list) -> str:
    more = f" and {len(things) - LISTED} more" if len(things) > LISTED else ""
    return ", ".join(str(t) for t in things[:LISTED]) + more
