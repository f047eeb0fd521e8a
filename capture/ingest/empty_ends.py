"""Pictures at the ends of a clip that show nothing yet, or no more: black, of one colour, or fading from or to that.

Files begin before the sensor does, and editors fade. When that happens says nothing of the scene and its time, so such
pictures are used for nothing: neither as frames nor for clocks, light or motion.
"""

import numpy as np
from jaxtyping import Float

EMPTY_LEVELS = 1.5  # standard deviation of a small grey picture; one colour, and what coding adds
EMPTY_SHARE = 0.25  # of the clip's usual contrast: a scene in the dark has little of it throughout
FADE_SHARE = 0.98  # of the usual contrast: from there on a picture is shown in full
# each picture of a fade has at least so many times the contrast of the one nearer to the end
FADE_STEP = 1.01


def empty_ends(contrast: Float[np.ndarray, " n"]) -> tuple[int, int]:
    """How many pictures at the start and at the end show nothing or fade.

    Args:
        contrast: Of each picture in order, the standard deviation of its grey levels.
    Returns:
        Two counts; zeros where most of the clip is empty, which then is what it shows.
    """
    usual = float(np.median(contrast)) if len(contrast) else 0.0
    if usual <= EMPTY_LEVELS:
        return 0, 0
    return _leading(contrast, usual), _leading(contrast[::-1], usual)


def empty_note(start: int, end: int) -> list[str]:
    """What to say of them; nothing where there are none."""
    where = [f"{count} at the {name}" for count, name in ((start, "start"), (end, "end")) if count]
    return [f"pictures that show nothing or fade, {' and '.join(where)}: not used"] if where else []


def _leading(contrast: Float[np.ndarray, " n"], usual: float) -> int:
    empty = contrast >= min(EMPTY_LEVELS, EMPTY_SHARE * usual)
    count = int(np.argmax(empty)) if empty.any() else 0
    if not count and contrast[0] >= EMPTY_SHARE * usual:
        return 0
    while (
        count + 1 < len(contrast)
        and contrast[count] < FADE_SHARE * usual
        and contrast[count + 1] > FADE_STEP * contrast[count]
    ):
        count += 1
    return count
