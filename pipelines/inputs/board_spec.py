"""The configured board as calibration wants it."""

from devrf.calibration.boards.calibrate import LensChoice
from devrf.calibration.boards.spec import BoardSpec
from devrf.pipelines.config.scene import SceneConfig


def board_spec(config: SceneConfig) -> BoardSpec | None:
    """What `capture.board` describes; None without a board."""
    board = config.board
    if board is None:
        return None
    side = (board.marker_m or 0.0) + (board.separation_m or 0.0)  # of a grid; another board has its square's
    return BoardSpec(
        type=board.type,
        squares=board.squares,
        square_m=side if board.square_m is None else board.square_m,
        marker_m=board.marker_m,
        dictionary=board.dictionary,
        inverted=board.inverted,
        legacy=board.legacy,
    )


def lens_choice(config: SceneConfig) -> LensChoice:
    """Which lens model board calibrations take."""
    return "auto" if config.board is None else config.board.lens
