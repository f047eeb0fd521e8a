"""All cameras brought to the look of one: the camera that shares most points with those already matched comes next.

Each camera is fitted against the corrected colours of the ones before it, so a camera that shares nothing with the
reference is reached over others. A quarter of the points (whole tiles of the picture) is never fitted: on it the error
is measured, before and after.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from devrf.calibration.colour.correction_fit import (
    ColourCorrection,
    brighter_by,
    difference,
    fit_correction,
    folds,
    needed,
)
from devrf.calibration.colour.surface import Pairs

HELD_BACK = 4  # one in so many tiles


@dataclass(frozen=True)
class Apart:
    """How far cameras lie apart on points that no fit has seen.

    Attributes:
        points: How many there are.
        before, after: Root mean square difference of sRGB channels in [0, 1]; None without points.
    """

    points: int
    before: float | None
    after: float | None


@dataclass(frozen=True)
class Matched:
    """Cameras of one look.

    Attributes:
        reference: Camera that all others are brought to.
        corrections: Camera -> correction; the reference and cameras that share too few points are not in it.
        fitted: Camera -> points that its correction was fitted to.
        brightness: Camera -> by how much it is brighter than the reference, stops, and the standard deviation.
        apart: Camera -> how far it lies from all others that it shares points with.
        total: The same over all pairs of cameras.
    """

    reference: str
    corrections: dict[str, ColourCorrection]
    fitted: dict[str, int]
    brightness: dict[str, tuple[float, float]]
    apart: dict[str, Apart]
    total: Apart

    def only(self, name: str) -> "Matched":
        """What is said of one camera."""
        corrections, fitted, brightness, apart = (
            {name: of[name]} if name in of else {}
            for of in (self.corrections, self.fitted, self.brightness, self.apart)
        )
        return replace(self, corrections=corrections, fitted=fitted, brightness=brightness, apart=apart)


def match_cameras(pairs: Sequence[Pairs], reference: str, measured: Collection[str] = ()) -> Matched:
    """Match all cameras of some pairs.

    Args:
        pairs: Colours of common points, of any two cameras.
        reference: Camera that the others are brought to.
        measured: Cameras that are measured and not corrected, nor used for others (test cameras).
    """
    corrections: dict[str, ColourCorrection] = {}
    fitted, brightness = {reference: 0}, {}
    names = {name for p in pairs for name in (p.first, p.second)} - {reference}
    waiting = names - set(measured)
    alike = max((p.alike for p in pairs), default=1)
    while waiting:
        found = {name: _against(pairs, name, fitted, corrections) for name in sorted(waiting)}
        name = max(found, key=lambda n: len(found[n][0]))
        colours, wanted, place = found[name]
        if len(colours) < needed("gain", alike):
            break
        corrections[name], fitted[name] = fit_correction(colours, wanted, place, alike), len(colours)
        brightness[name] = brighter_by(colours, wanted, alike)
        waiting.remove(name)
    for name in sorted(names & set(measured)):
        colours, wanted, _ = _against(pairs, name, fitted, corrections)
        if len(colours) >= needed("gain", alike):
            brightness[name] = brighter_by(colours, wanted, alike)
    kept = [p for p in pairs if not {p.first, p.second} & set(measured)]
    apart = {n: _apart([p for p in pairs if _about(p, n, measured)], corrections) for n in sorted(names)}
    del fitted[reference]
    return Matched(reference, corrections, fitted, brightness, apart, _apart(kept, corrections))


def _about(pairs: Pairs, name: str, measured: Collection[str]) -> bool:
    """Whether these pairs tell of a camera, the other one being no camera that is only measured."""
    other = {pairs.first, pairs.second} - {name}
    return len(other) == 1 and not other & set(measured)


def _held(pairs: Pairs) -> Bool[np.ndarray, " n"]:
    return folds(pairs.place[:, ::-1], HELD_BACK) == 0  # other tiles than the folds of a fit


def _against(
    pairs: Sequence[Pairs], name: str, done: Collection[str], corrections: dict[str, ColourCorrection]
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Colours in a camera, the corrected ones of the cameras done, and places, of points that may be fitted."""
    colours, wanted, place = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros((0, 2))]
    for p in pairs:
        for own, other, side in ((p.first, p.second, 0), (p.second, p.first, 1)):
            if own == name and other in done:
                use = ~_held(p)
                colours.append(p.colours[use, side])
                wanted.append(_corrected(p.colours[use, 1 - side], other, corrections))
                place.append(p.place[use])
    return np.concatenate(colours), np.concatenate(wanted), np.concatenate(place)


def _corrected(
    colours: Float[np.ndarray, "n 3"], name: str, corrections: dict[str, ColourCorrection]
) -> Float[np.ndarray, "n 3"]:
    return colours @ corrections[name].matrix.T if name in corrections else colours


def _apart(pairs: Sequence[Pairs], corrections: dict[str, ColourCorrection]) -> Apart:
    before, after = [np.zeros(0)], [np.zeros(0)]
    for p in pairs:
        a, b = (p.colours[_held(p), side] for side in (0, 1))
        before.append(difference(a, b))
        after.append(difference(_corrected(a, p.first, corrections), _corrected(b, p.second, corrections)))
    squares = [np.square(np.concatenate(e)) for e in (before, after)]
    count = len(squares[0])
    return Apart(count, *(float(np.sqrt(s.mean())) if count else None for s in squares))
