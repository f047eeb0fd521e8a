"""Photos' places by GPS: local metres, and how the sweep's model lies among them.

Local metres are east, north, up about the median place (spherical Earth of the ellipsoid's local radii; exact to
a millimetre over the kilometre a sweep spans). The similarity is fitted robustly, because a phone's first
fixes may be tens of metres off.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from math import ceil

import numpy as np
from jaxtyping import Bool, Float

from devrf.calibration.truth import similarity
from devrf.capture.exif import Place

# Of a phone under open sky, horizontally (GPS.gov: 4.9 m within 95 % at best); where unsaid.
USUAL_STD_M = 4.0
UP_STD = 2.0  # heights are that much worse than places
SPREAD = 3.0  # the camera must have moved this many standard deviations for GPS to say anything
FEWEST = 6  # places; a similarity has 7 unknowns, and outliers must be told from them
SHARE = 0.5  # of the pictures must have a place
OUTLIER = 3.0  # standard deviations
TRIALS = 300  # triplets; with half the places wrong one in eight is right
SEMI_MAJOR_M, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3  # WGS 84


@dataclass(frozen=True)
class GpsAlignment:
    """Where the sweep's model lies in local metres.

    Attributes:
        metres_from_model: Similarity [4, 4].
        factor: Metres per unit of the model.
        factor_std: Its relative standard deviation.
        rms_m: Of the places that agree, horizontally and vertically together.
        off_m: Distance of every place from its camera [N], in the order of the model's cameras.
        used: Which agree [N].
    """

    metres_from_model: Float[np.ndarray, "4 4"]
    factor: float
    factor_std: float
    rms_m: float
    off_m: Float[np.ndarray, " n"]
    used: Bool[np.ndarray, " n"]


def local_metres(
    places: Mapping[str, Place | None],
) -> tuple[dict[str, Float[np.ndarray, "3"]], dict[str, float]]:
    """East, north, up [3] about the median place, metres, of pictures with a place; and their horizontal std."""
    known = {name: p for name, p in places.items() if p is not None}
    if not known:
        return {}, {}
    lat = np.radians(np.median([p.latitude_deg for p in known.values()]))
    # of longitudes the one nearest all others: sweeps may lie on the date line
    reference = next(iter(known.values())).longitude_deg
    turns = {n: (p.longitude_deg - reference + 180) % 360 - 180 for n, p in known.items()}
    middle = float(np.median(list(turns.values())))
    heights = [p.altitude_m for p in known.values() if p.altitude_m is not None]
    height = float(np.median(heights)) if heights else 0.0
    root = 1 - ECCENTRICITY2 * np.sin(lat) ** 2
    north_m = SEMI_MAJOR_M * (1 - ECCENTRICITY2) / root**1.5  # per radian
    east_m = SEMI_MAJOR_M / np.sqrt(root) * np.cos(lat)
    metres = {
        name: np.array(
            [
                east_m * np.radians(turns[name] - middle),
                north_m * (np.radians(p.latitude_deg) - lat),
                (p.altitude_m if p.altitude_m is not None else height) - height,
            ]
        )
        for name, p in known.items()
    }
    return metres, {name: p.std_m or USUAL_STD_M for name, p in known.items()}


def why_not(metres: Mapping[str, np.ndarray], std_m: Mapping[str, float], pictures: int) -> str:
    """Why these places cannot guide the sweep, in words; empty where they can."""
    need = max(FEWEST, ceil(SHARE * pictures))
    if len(metres) < need:
        return f"{len(metres)} of {pictures} pictures have a place, need {need}"
    xy = np.array(list(metres.values()))[:, :2]
    extent_m = float(np.sqrt(((xy - np.median(xy, axis=0)) ** 2).sum(1).mean()))
    noise_m = float(np.median(list(std_m.values())))
    if extent_m < SPREAD * noise_m:
        return f"the places spread over {extent_m:.1f} m, their own error is about {noise_m:.1f} m"
    return ""


def align(
    centres: Float[np.ndarray, "n 3"], metres: Float[np.ndarray, "n 3"], std_m: Float[np.ndarray, " n"]
) -> GpsAlignment | None:
    """Fit the model to the places; None where fewer than `FEWEST` of them agree.

    Args:
        centres: Of the cameras, in the model's unit.
        metres: Their places.
        std_m: Horizontal standard deviation of each place.
    """
    if len(centres) < FEWEST:
        return None
    trials = np.array(list(combinations(range(len(centres)), 3)))
    if len(trials) > TRIALS:
        trials = trials[np.random.default_rng(0).choice(len(trials), TRIALS, replace=False)]
    best: tuple[float, np.ndarray] | None = None
    with np.errstate(divide="ignore", invalid="ignore"):
        for trial in trials:
            off = _standard_deviations(similarity(centres[trial], metres[trial]), centres, metres, std_m)
            cost = np.minimum(off, OUTLIER).sum()  # truncated: robust to half of them being wrong
            if np.isfinite(cost) and (best is None or cost < best[0]):
                best = (float(cost), off <= OUTLIER)
    if best is None:
        return None
    metres_from_model, used = np.eye(4), best[1]
    for _ in range(3):  # the fit decides who agrees, those decide the fit
        if used.sum() < FEWEST:
            return None
        metres_from_model = similarity(centres[used], metres[used])
        used = _standard_deviations(metres_from_model, centres, metres, std_m) <= OUTLIER
    if used.sum() < FEWEST:
        return None
    moved = centres @ metres_from_model[:3, :3].T + metres_from_model[:3, 3]
    off_m = np.linalg.norm(moved - metres, axis=1)
    rms_m = float(np.sqrt((off_m[used] ** 2).mean()))
    spread_m = moved[used] - moved[used].mean(0)
    # one axis' error over the root of the sum of squares: least squares of a scale
    factor_std = rms_m / float(np.sqrt(3 * (spread_m**2).sum()))
    factor = float(np.cbrt(np.linalg.det(metres_from_model[:3, :3])))
    return GpsAlignment(metres_from_model, factor, factor_std, rms_m, off_m, used)


def _standard_deviations(
    metres_from_model: np.ndarray, centres: np.ndarray, metres: np.ndarray, std_m: np.ndarray
) -> np.ndarray:
    off = centres @ metres_from_model[:3, :3].T + metres_from_model[:3, 3] - metres
    return np.sqrt((off[:, :2] ** 2).sum(1) / 2 + (off[:, 2] / UP_STD) ** 2) / std_m
