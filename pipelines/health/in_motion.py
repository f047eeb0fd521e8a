"""What was learned of motion, by the pictures of the training cameras alone."""

from collections.abc import Iterator, Mapping
from statistics import fmean

from devrf.capture.measure import Measure, highest, lowest
from devrf.reconstruct.check_motion import MotionFit


def in_motion_measures(cameras: Mapping[str, MotionFit]) -> Iterator[Measure]:
    """The worst camera each; none where no camera's pictures change."""
    if not cameras:
        return
    yield lowest("motion-gain", {name: fit.gain_db for name, fit in cameras.items()})
    yield highest("motion-empty", {name: fit.unreachable for name, fit in cameras.items()}, 100)
    yield highest("motion-still", {name: fit.unmoved for name, fit in cameras.items()}, 100)
    alone = [fit.alone for fit in cameras.values() if fit.alone is not None]
    if alone:
        yield Measure("motion-one-sided", 100 * fmean(alone))
    yield highest("motion-late", {name: abs(fit.better_at) for name, fit in cameras.items()})
