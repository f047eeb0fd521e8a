"""Health rows about the scene at rest as the fixed cameras see it: asked before motion is learned from them."""

from collections.abc import Iterator, Mapping, Sequence
from math import inf, isinf
from statistics import median

from devrf.pipelines.health.rows import HealthRow, note, row
from devrf.reconstruct.check_rest import PlateFit, RestCheck, RestFit

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
SHIFTED = (
    "A small shift takes away that much of what {} differs by: its pose or focal length is off; film the board with "
    "this zoom (capture.board.clips), and leave tripod and zoom as they are."
)
AT_OTHER_TIME = (
    "A few frames before or after, {} shows the scene at rest that much better: its clock is off, or capture.rest "
    "names another moment; clap, and let the clips begin with the scene at rest."
)


def at_rest_rows(found: RestCheck) -> list[HealthRow]:
    """Rows about the worst camera's picture at rest, a row for every fixed camera that has a clean plate, and one on
    what poses and clocks have to do with it; none where nothing can be told.
    """
    return [*_beside(found.cameras, found.sweep), *_unlike(found.cameras, found.sweep), *_plates(found)]


def _beside(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> list[HealthRow]:
    of_sweep = _usual(sweep)
    if isinf(of_sweep):  # the sweep's own pictures are not found again: nothing can be told by that
        return []
    found = {
        name: (fit.displaced.length, max(MOST_VOXELS * fit.voxel, of_sweep) + SURE * fit.displaced.std)
        for name, fit in cameras.items()
        if fit.displaced is not None
    }
    if not found:
        return []
    name = max(found, key=lambda n: found[n][0] / found[n][1])
    length, most = found[name]
    return [
        row(
            f"picture beside the scene at rest, worst camera ({name})",
            100 * length,
            "% of its width",
            warn_above=100 * most,
            remedy=f"{name} does not stand where the rig says, or has another focal length: leave tripod and zoom as "
            "they are between board, sweep and clip, film the board with this zoom (capture.board.clips), and let the "
            "sweep show what this camera sees.",
        )
    ]


def _unlike(cameras: Mapping[str, RestFit], sweep: Sequence[RestFit]) -> list[HealthRow]:
    right = [fit.psnr for fit in sweep if fit.psnr is not None]
    found = {name: fit.psnr for name, fit in cameras.items() if fit.psnr is not None}
    if len(right) < 2 or not found:
        return []
    name = min(found, key=lambda n: found[n])
    return [
        row(
            f"PSNR of the scene at rest, worst camera ({name})",
            found[name],
            "dB",
            warn=min(min(right), median(right) - WORSE_DB),
            remedy=f"{name} does not show what the sweep shows: let its clip begin with the scene as in the sweep "
            "(capture.rest), with the same light, exposure and white balance, keep people and shadows out, and check "
            "its pose in the report.",
        )
    ]


def _plates(found: RestCheck) -> Iterator[HealthRow]:
    least = median(found.sweep_psnr) - WORSE_DB if len(found.sweep_psnr) > 1 else -inf
    for name, plate in found.plates.items():
        yield note(
            f"clean plate against the scene at rest ({name})",
            _told(plate),
            remedy=_what_is_wrong(name, plate, least, _usual(found.sweep)),
        )
    shares = [
        (share, most, name, remedy)
        for name, plate in found.plates.items()
        if plate.psnr is not None
        for share, most, remedy in (
            (plate.by_place, MOST_OF_PLATE, SHIFTED),
            (plate.rest_by_place, MOST_OF_REST, SHIFTED),
            (plate.rest_by_time, MOST_OF_REST, AT_OTHER_TIME),
        )
    ]
    if shares:
        share, most, name, remedy = max(shares, key=lambda s: s[0] / s[1])
        yield row(
            f"error at rest that poses and clocks explain, worst camera ({name})",
            100 * share,
            "%",
            warn_above=100 * most,
            remedy=remedy.format(name),
        )


def _told(plate: PlateFit) -> str:
    if plate.psnr is None:
        return f"{100 * plate.known:.0f} % of its picture stands"
    beside = "too plain to tell its place"
    if plate.displaced is not None:
        more = "" if plate.displaced.found else "more than "
        beside = f"{more}{100 * plate.displaced.length:.2f} % of its width beside"
    return f"{plate.psnr:.1f} dB, {beside}"


def _what_is_wrong(name: str, plate: PlateFit, least: float, of_sweep: float) -> str:
    """The remedy for the first of a plate's faults; empty where there is none."""
    if plate.psnr is None or plate.known < LEAST_STANDING:
        return (
            f"{name} never shows anything at rest: something changes everywhere in its picture. Set it on a tripod, "
            "lock exposure and focus, and let it see what stands beside the subject: its pose cannot be checked."
        )
    if plate.textured < LEAST_TEXTURED:
        return (
            f"{name} shows next to nothing but a plain surface where nothing moves: neither its pose nor its picture "
            "can be checked. Turn it so that things with a pattern are in its picture, or hang something up."
        )
    shift = plate.displaced
    most = max(MOST_VOXELS * plate.voxel, of_sweep)
    if shift is not None and shift.length > most + SURE * shift.std:
        return (
            f"{name} does not stand where the rig says, or has another focal length: leave tripod and zoom as they "
            "are between board, sweep and clip, and film the board with this zoom (capture.board.clips)."
        )
    if plate.psnr < least and plate.by_light > MOSTLY:
        return (
            f"{name} saw the scene in other light, or with another exposure or white balance, than the sweep: leave "
            "lamps, curtains and settings as they are."
        )
    if plate.odd > MOST_ODD:
        x, y = plate.odd_at
        return (
            f"{name} shows something {100 * x:.0f} % from the left and {100 * y:.0f} % from the top of its picture "
            "that the sweep does not show: keep people out of what fixed cameras see, and let nothing be moved between "
            "sweep and clips."
        )
    if plate.psnr < least:
        return (
            f"What {name} sees is not what was learned: let the sweep go where this camera looks, and check its pose "
            "in the report."
        )
    return ""


def _usual(sweep: Sequence[RestFit]) -> float:
    """How far the sweep's own held-out pictures lie beside the model, in widths; infinite where they are not found."""
    found = [
        fit.displaced.length if fit.displaced.found else inf for fit in sweep if fit.displaced is not None
    ]
    return median(found) if found else 0.0
