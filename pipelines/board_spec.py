"""The configured board as calibration wants it."""

from devrf.calibration.board import BoardSpec
from devrf.pipelines.scene_config import SceneConfig


def board_spec(config: SceneConfig) -> BoardSpec | None:
    """What `capture.board` describes; None without a board."""
    board = None if config.capture is None else config.capture.board
    if board is None:
        return None
    return BoardSpec(
        type=board.type,
        squares=board.squares,
        square_m=board.square_m,
        marker_m=board.marker_m,
        dictionary=board.dictionary,
        inverted=board.inverted,
        legacy=board.legacy,
    )
