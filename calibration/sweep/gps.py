"""Photos' places by GPS, in local metres: they guide the mapper and the choice of pairs.

Local metres are east, north, up about the median place (spherical Earth of the ellipsoid's local radii; exact to
a millimetre over the kilometre a sweep spans).
"""

from collections.abc import Mapping
from math import ceil

import numpy as np
from jaxtyping import Float

from devrf.capture.exif import Place

# Of a phone under open sky, horizontally (GPS.gov: 4.9 m within 95 % at best); where unsaid.
USUAL_STD_M = 4.0
UP_STD = 2.0  # heights are that much worse than places
SPREAD = 3.0  # the camera must have moved this many standard deviations for GPS to say anything
FEWEST = 6  # places: a phone's first fixes may be tens of metres off
SHARE = 0.5  # of the pictures must have a place
SEMI_MAJOR_M, ECCENTRICITY2 = 6378137.0, 6.69437999014e-3  # WGS 84


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
