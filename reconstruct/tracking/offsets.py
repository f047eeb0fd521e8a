"""By how much later each camera took its pictures than its clock says: seen in what tracking leaves unexplained.

A camera whose clock is wrong shows points a little farther along their way, or less far. Tracks are a compromise
between all cameras and hide a part of that: so it is asked for all offsets together with where each point would then
be (variable projection, Golub and Pereyra 1973). When all cameras are late together nothing is seen: their median
clock stays.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

LEAST_WAY = 0.5  # pixels that a point goes from moment to moment, in a camera, to say anything of time
FEWEST_POINTS = 50  # that do, and are seen by two cameras
FEWEST_CAMERAS = 2  # at one moment: one says nothing of itself
ERROR_PX = 0.5  # that the tracks of one moment are off by, all points together
BEFORE = 1.0  # standard deviation of a clock before anything is seen, in moments
CLEAR, SIGMAS = 0.1, 3.0  # moments, and standard deviations, from which an offset is clear
THIN = 1e-6  # of a point's trace, added: one that is nearly seen along one line only


class Shown(NamedTuple):
    """What one picture shows of points.

    Attributes:
        points: Their numbers [m].
        left: From where they are expected to where they are shown, in pixels [m, 2].
        derivative: Of pixels by places [m, 2, 3].
        weight: Of each [m].
    """

    points: Int[np.ndarray, " m"]
    left: Float[np.ndarray, "m 2"]
    derivative: Float[np.ndarray, "m 2 3"]
    weight: Float[np.ndarray, " m"]


class Offsets:
    """Offsets that are known, and what moments say of them.

    Attributes:
        now: By how much later pictures are taken, in the scene's time [c].
        information, pull: Normal equations of the offsets [c, c], [c].
    """

    def __init__(self, now: Float[np.ndarray, " c"]) -> None:
        self.now = now
        self.information, self.pull = np.zeros((len(now), len(now))), np.zeros(len(now))

    def add(self, shown: Mapping[int, Shown], way: Float[np.ndarray, "p 3"], gap: float) -> None:
        """What the pictures of one moment show, by camera.

        Args:
            shown: By camera.
            way: Of all points since the moment before.
            gap: Between both, in the scene's time.
        """
        place, pull = (
            np.zeros((len(way), 3, 3)),
            np.zeros((len(way), 3)),
        )  # of each point: its normal equations
        cameras, goes = np.zeros(len(way), dtype=int), np.zeros(len(way), dtype=bool)
        along = {}
        for camera, (points, left, derivative, weight) in shown.items():
            weighted = derivative * weight[:, None, None]
            place[points] += np.einsum("mia,mib->mab", weighted, derivative)
            pull[points] += np.einsum("mia,mi->ma", weighted, left)
            along[camera] = np.einsum("mia,ma->mi", derivative, way[points])
            cameras[points] += 1
            goes[points] |= np.linalg.norm(along[camera], axis=1) > LEAST_WAY
        tell = goes & (cameras >= FEWEST_CAMERAS)
        if tell.sum() < FEWEST_POINTS:
            return
        trace = np.trace(place[tell], axis1=1, axis2=2)
        place[tell] += np.eye(3) * (THIN * trace[:, None, None] + 1e-12)
        inverse = np.linalg.inv(place[tell])
        by_place = np.zeros((len(self.now), len(way), 3))
        information, sums = np.zeros_like(self.information), np.zeros_like(self.pull)
        for camera, (points, left, derivative, weight) in shown.items():
            mine = tell[points]
            weighted = weight[mine, None] * along[camera][mine]
            by_place[camera, points[mine]] = np.einsum("mi,mia->ma", weighted, derivative[mine])
            information[camera, camera] = (weighted * along[camera][mine]).sum()
            sums[camera] = (weighted * left[mine]).sum()
        by_place = by_place[:, tell]
        hidden = np.einsum("cpa,pab->cpb", by_place, inverse)
        information -= np.einsum("cpb,dpb->cd", hidden, by_place)
        sums -= np.einsum("cpb,pb->c", hidden, pull[tell])
        count = tell.sum() * ERROR_PX**2
        self.information += information / count / gap**2
        self.pull += (information @ self.now / gap**2 + sums / gap) / count


def offsets_of(seen: Mapping[int, Offsets], gap: float) -> tuple[np.ndarray, Bool[np.ndarray, " c"]]:
    """Offsets from the median of all cameras, in the scene's time, and which of them are clear.

    Args:
        seen: With 1; with -1 where time ran back.
        gap: Between moments, in the scene's time.
    """
    information = sum(one.information for one in seen.values())
    pull = sum(sign * one.pull for sign, one in seen.items())
    covariance = np.linalg.inv(information + np.eye(len(information)) / (BEFORE * gap) ** 2)
    offset = covariance @ pull
    apart = offset - np.median(offset)
    from_mean = np.eye(len(offset)) - 1 / len(offset)
    variance = (from_mean @ covariance @ from_mean.T).diagonal()
    return apart, np.abs(apart) > np.maximum(CLEAR * gap, SIGMAS * np.sqrt(variance))
