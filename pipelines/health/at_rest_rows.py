"""The scene at rest as the fixed cameras see it: asked before motion is learned from them."""

from collections.abc import Iterator, Mapping, Sequence
from math import inf, isinf
from statistics import median

from devrf.capture.measure import Measure, lowest
from devrf.reconstruct.evaluation.check_rest import PlateFit, RestCheck, RestFit

# A picture may lie so far beside the model: two cameras then disagree by a voxel, which reads as motion.
MOST_VOXELS = 0.5
SURE = 2.0  # standard deviations beyond that
WORSE_DB = 3.0  # than the sweep's held-out pictures: half of the camera's error is not the model's
LEAST_STANDING = 0.02  # of a camera's picture: less is no clean plate
LEAST_TEXTURED = 8  # blocks of the picture with texture, for a place to be told
MOST_ODD = 0.02  # of the picture: somebody who stands there, or a thing that was carried away
MOSTLY = 0.5  # of the error, for its one reason
# Of the error, that a shift or another moment takes away. Of plates half a decibel, of the little that the sweep alone
# has taught one: in six captures at most 0.06; 0.18 and 0.06. A camera turned by 0.8 degrees: 0.00; 0.83.
MOST_OF_PLATE, MOST_OF_REST = 0.11, 0.2


def at_rest_measures(found: RestCheck) -> list[Measure]:
    """The worst camera's picture at rest, every clean plate that is wrong, and what poses and clocks have to do with
    it; none where nothing can be told.
    """
    return [*_beside(found.cameras, found.sweep), *_unlike(found.cameras, found.sweep), *_plates(found)]


def _beside(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> Iterator[Measure]:
    of_sweep = _usual(sweep)
    found = {
        name: (fit.displaced.length, max(MOST_VOXELS * fit.voxel, of_sweep) + SURE * fit.displaced.std)
        for name, fit in cameras.items()
        if fit.displaced is not None
    }
    if found and not isinf(
        of_sweep
    ):  # else the sweep's own pictures are not found again: nothing can be told by that
        name = max(found, key=lambda n: found[n][0] / found[n][1])
        length, most = found[name]
        yield Measure("rest-beside", 100 * length, name, warn=100 * most)


def _unlike(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> Iterator[Measure]:
    right = [fit.psnr for fit in sweep if fit.psnr is not None]
    found = {name: fit.psnr for name, fit in cameras.items() if fit.psnr is not None}
    if len(right) > 1 and found:
        yield lowest("rest-unlike", found, warn=min(min(right), median(right) - WORSE_DB))


def _plates(found: RestCheck) -> Iterator[Measure]:
    least = median(found.sweep_psnr) - WORSE_DB if len(found.sweep_psnr) > 1 else -inf
    for name, plate in found.plates.items():
        why = _what_is_wrong(plate, least, _usual(found.sweep))
        if why:
            facts = {"across": 100 * plate.odd_at[0], "down": 100 * plate.odd_at[1]} if why == "odd" else {}
            yield Measure("rest-plate", _told(plate), name, why, facts)
    shares = [
        (share, most, name, why)
        for name, plate in found.plates.items()
        if plate.psnr is not None
        for share, most, why in (
            (plate.by_place, MOST_OF_PLATE, "place"),
            (plate.rest_by_place, MOST_OF_REST, "place"),
            (plate.rest_by_time, MOST_OF_REST, "time"),
        )
    ]
    if shares:
        share, most, name, why = max(shares, key=lambda s: s[0] / s[1])
        yield Measure("rest-explained", 100 * share, name, why, warn=100 * most)


def _told(plate: PlateFit) -> str:
    if plate.psnr is None:
        return f"{100 * plate.known:.0f} % of its picture stands"
    beside = "too plain to tell its place"
    if plate.displaced is not None:
        more = "" if plate.displaced.found else "more than "
        beside = f"{more}{100 * plate.displaced.length:.2f} % of its width beside"
    return f"{plate.psnr:.1f} dB, {beside}"


def _what_is_wrong(plate: PlateFit, least: float, of_sweep: float) -> str:
    """The first of a plate's faults; empty where there is none."""
    if plate.psnr is None or plate.known < LEAST_STANDING:
        return "none"
    if plate.textured < LEAST_TEXTURED:
        return "plain"
    shift = plate.displaced
    most = max(MOST_VOXELS * plate.voxel, of_sweep)
    if shift is not None and shift.length > most + SURE * shift.std:
        return "beside"
    if plate.psnr < least and plate.by_light > MOSTLY:
        return "light"
    if plate.odd > MOST_ODD:
        return "odd"
    return "unlike" if plate.psnr < least else ""


def _usual(sweep: Sequence[RestFit]) -> float:
    """How far the sweep's own held-out pictures lie beside the model, in widths; infinite where they are not found."""
    found = [
        fit.displaced.length if fit.displaced.found else inf for fit in sweep if fit.displaced is not None
    ]
    return median(found) if found else 0.0
