"""When the lens of a film zoomed: the cut in time at which two lenses explain its pictures, where one does not."""

from collections.abc import Callable
from typing import NamedTuple

FEWEST = 6  # pictures of a part
COARSE = 8  # parts of the film between which is cut first
BETTER = 0.97  # of the error with one lens
HINT = 0.998  # of that error, when cut in the middle: where nothing happened it stays within 0.02 %


class TwoLenses(NamedTuple):
    """The film, cut in two: mean reprojection error, pixels, and the focal lengths before and after."""

    error_px: float
    before_px: float
    after_px: float


def zoom_step(
    fit: Callable[[int], TwoLenses], count: int, doubted: bool = True
) -> tuple[int, TwoLenses, float] | None:
    """The number of the first picture after the zoom, what fits then, and its error over that of one lens; None where
    one does as well.

    Args:
        fit: What fits a film that is cut before a picture; 0: one that is not cut.
        count: Pictures of the film.
        doubted: One lens explains it badly; else it is only looked further if a cut in the middle helps.
    """
    tried: dict[int, TwoLenses] = {}

    def error_px(cut: int) -> float:
        if cut not in tried:
            tried[cut] = fit(cut)
        return tried[cut].error_px

    step = max(1, count // COARSE)
    cuts = range(FEWEST, count - FEWEST + 1)
    if not cuts or not (doubted or error_px(count // 2) < HINT * error_px(0)):
        return None
    best = min(cuts[::step], key=error_px)
    while step > 1:
        step = (step + 1) // 2
        best = min((c for c in (best, best - step, best + step) if c in cuts), key=error_px)
    share = error_px(best) / error_px(0)
    return (best, tried[best], share) if share < BETTER else None
