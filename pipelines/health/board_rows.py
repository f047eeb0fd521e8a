"""One camera's board calibration, for the stages that make one."""

from collections.abc import Iterator

from devrf.calibration.boards.calibrate import BoardCalibration
from devrf.capture.frames import some
from devrf.capture.measure import Measure
from devrf.pipelines.health.judge import refuses_at, warns_at

MISREAD = 10.0  # times the median error: such a view was not a bad one, but misread
BOW_SHARE = 0.003  # of the board's longer side: 1 mm of 33 cm, which moves the focal length by some tenths of a percent
MOST_CORNERS = 2  # of a picture, that the board may never have shown


def fits(board: BoardCalibration) -> bool:
    """Whether a board's calibration is better than none."""
    return board.rms_px <= refuses_at("board-error")


def board_measures(name: str, board: BoardCalibration) -> Iterator[Measure]:
    """What calibrates `name`: the board, how it was held, and how well it fits; else it is not used, which is said."""
    wrong = ", ".join(f"{key}: {value}" for key, value in board.board.corrections)
    if wrong:
        yield Measure("board-corrected", board.board.words, name, facts={"wrong": wrong})
    dropped = f" Dropped views: {some(list(board.dropped))}." if board.dropped else ""
    std = board.intrinsics.std
    doubt = "unknown" if std is None else f"+- {max(std[2], std[3]):.1f} px"
    unused = "" if fits(board) else " It is not used: other pictures have to tell of the lens."
    yield Measure(
        "board-error", board.rms_px, name, facts={"dropped": f"{dropped}{unused}"}, refuses=not unused
    )
    yield Measure("board-views", board.views, name, facts={"doubt": doubt, "dropped": dropped})
    yield from _left_out(name, board)
    yield Measure("board-tilt", board.evidence.tilt_sectors, name)
    unseen = ", ".join(board.evidence.unseen)
    never = {"never": f" Never seen: {unseen}." if unseen else ""}
    coverage = board.evidence.coverage
    corners = sum("corner" in place for place in board.evidence.unseen)
    cut = coverage >= warns_at("board-coverage") and corners > MOST_CORNERS
    value = f"never seen in {corners} corners" if cut else coverage
    yield Measure("board-coverage", value, name, facts=never)
    bow, std_mm = max(zip(board.bow_mm, board.bow_std_mm, strict=True), key=lambda along: abs(along[0]))
    if bow != 0.0:
        corners_m = board.board.corners
        side_mm = 1e3 * float((corners_m.max(0) - corners_m.min(0)).max())
        yield Measure("board-bow", abs(bow), name, facts={"std_mm": std_mm}, warn=BOW_SHARE * side_mm)


def _left_out(name: str, board: BoardCalibration) -> Iterator[Measure]:
    """Views that were left out, where they are too many or were misread."""
    blurred, dropped = list(board.blurred), board.dropped
    errors = some([f"{frame} ({error:.1f} px)" for frame, error in dropped.items()])
    said = [f"blurred {some(blurred)}"] if blurred else []
    text = "left out: " + "; ".join([*said, *([f"do not fit {errors}"] if dropped else [])])
    count = board.views + len(blurred) + len(dropped)
    why = (
        "blurred"
        if len(blurred) > count / 4
        else "misread"
        if any(error > MISREAD * board.rms_px for error in dropped.values())
        else "unfit"
        if len(dropped) > count / 4
        else ""
    )
    if why:
        yield Measure("board-views", text, name, why, {"blurred": len(blurred), "count": count})
