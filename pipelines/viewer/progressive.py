"""Sizes of the pictures of one view: a small one that comes at once, then larger ones while nobody asks for another."""

MOVING_S = 0.12  # what a picture of a view that changes may take: eight a second look like motion
FINER = 4  # times as many pixels has the next picture of a view that rests
FIRST = 12_000.0  # pixels, until a picture has been timed: a core has them in time
FEWEST = 1_000.0  # pixels: less shows nothing
SURPRISE = 4.0  # a picture changes the budget by no more: one may have had to wait for something else


def in_time(budget: float, pixels: int, seconds: float) -> float:
    """Pixels that are there in time, learned from a picture beside those before.

    Args:
        budget: What was thought so far.
        pixels, seconds: Of the picture; most of a small one's time has nothing to do with its size.
    """
    factor = min(max(MOVING_S / max(seconds, 1e-6), 1 / SURPRISE), SURPRISE)
    return max(FEWEST, (budget + pixels * factor) / 2)


def at_most(width: int, height: int, pixels: int | float) -> tuple[int, int]:
    """Width and height of the largest picture of this shape with at most so many pixels."""
    scale = min(1.0, (pixels / (width * height)) ** 0.5)
    return max(2, int(width * scale)), max(2, int(height * scale))
