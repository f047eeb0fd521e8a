"""By how much later each camera took its pictures than its clock says: seen in what tracking leaves unexplained.

A camera whose clock is wrong shows points a little farther along their way, or less far. Tracks are a compromise
between all cameras and hide a part of that: so it is asked for all offsets together with where each point would then
be (variable projection, Golub and Pereyra 1973). When all cameras are late together nothing is seen: their median
clock stays.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

LEAST_WAY = 0.5  # pixels that a point goes from moment to moment, in a camera, to say anything of time
FEWEST_POINTS = 50  # that do, and are seen by two cameras
FEWEST_CAMERAS = 2  # at one moment: one says nothing of depth, nor of its own clock
ERROR_PX = 0.5  # that the tracks of one moment are off by, all points together
MOMENTS = 8  # in a row, and points in one corner of what moves, err together
BEFORE = 1.0  # standard deviation of a clock before anything is seen, in moments
CLEAR, SIGMAS = 0.15, 4.0  # moments, and standard deviations, from which an offset is clear
# Standard deviations from which others beside a clear one are followed: beside a late clock a right one seemed to be
# off by 2.5, those that were wrong (by a sixth of a moment and more) by 3.8 and more.
LIKELY = 3.0
# Of an offset, that tracks show at least; 0.5 to 0.6 was measured. Less would be a step into the dark.
LEAST_SHOWN = 1 / 3
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


class Block(NamedTuple):
    """What points of one corner say in some moments in a row: normal equations of the offsets."""

    information: Float[np.ndarray, "c c"]
    pull: Float[np.ndarray, " c"]


class Offsets:
    """Offsets that are known, and what moments say of them.

    Attributes:
        now: By how much later pictures are taken, in the scene's time [c].
        blocks: What was seen, by moments and corner.
    """

    def __init__(self, now: Float[np.ndarray, " c"], xyz: Float[np.ndarray, "p 3"]) -> None:
        """Nothing has been seen.

        Args:
            now: Offsets that are known.
            xyz: The points at rest.
        """
        self.now = now
        self.blocks: dict[tuple[int, int], Block] = {}
        self._corner = (xyz > np.median(xyz, axis=0)) @ np.array([1, 2, 4])
        self._moments = 0

    def add(self, shown: Mapping[int, Shown], way: Float[np.ndarray, "p 3"], gap: float) -> None:
        """What the pictures of one moment show.

        Args:
            shown: By camera.
            way: Of all points since the moment before.
            gap: Between both, in the scene's time.
        """
        # Of each point: the normal equations of where it is.
        place, pull = np.zeros((len(way), 3, 3)), np.zeros((len(way), 3))
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
        inverse = np.zeros_like(place)
        inverse[tell] = np.linalg.inv(place[tell])
        # Of each point: by how much what it says of the offsets depends on where it is, and on the offsets themselves.
        by_place = np.zeros((len(way), len(self.now), 3))
        own, sums = np.zeros((2, len(way), len(self.now)))
        for camera, (points, left, derivative, weight) in shown.items():
            weighted = weight[:, None] * along[camera]
            by_place[points, camera] = np.einsum("mi,mia->ma", weighted, derivative)
            own[points, camera] = (weighted * along[camera]).sum(1)
            sums[points, camera] = (weighted * left).sum(1)
        hidden = np.einsum("pca,pab->pcb", by_place, inverse)
        sums -= np.einsum("pcb,pb->pc", hidden, pull)
        for corner in np.unique(self._corner[tell]):
            mine = tell & (self._corner == corner)
            information = np.diag(own[mine].sum(0)) - np.einsum("pcb,pdb->cd", hidden[mine], by_place[mine])
            information /= tell.sum() * ERROR_PX**2 * gap**2
            seen = information @ self.now + sums[mine].sum(0) / (tell.sum() * ERROR_PX**2 * gap)
            key = self._moments // MOMENTS, int(corner)
            before = self.blocks.get(key)
            if before is not None:
                information, seen = information + before.information, seen + before.pull
            self.blocks[key] = Block(information, seen)
        self._moments += 1

    def state(self) -> dict[str, np.ndarray]:
        """What has been seen."""
        cameras = len(self.now)
        blocks = self.blocks.values()
        return {
            "moments": np.array(self._moments),
            "keys": np.array(list(self.blocks), dtype=int).reshape(-1, 2),
            "information": np.array([b.information for b in blocks]).reshape(-1, cameras, cameras),
            "pull": np.array([b.pull for b in blocks]).reshape(-1, cameras),
        }

    def take_up(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a `state`."""
        self._moments = int(state["moments"])
        every = zip(state["keys"].tolist(), state["information"], state["pull"], strict=True)
        self.blocks = {(moment, corner): Block(a, b) for (moment, corner), a, b in every}


def offsets_of(
    seen: Mapping[int, Offsets], gap: float
) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " c"]]:
    """Offsets from the median of all cameras, in the scene's time, and their standard deviations.

    These are the larger ones of those by `ERROR_PX` and those by how much blocks differ ("sandwich": White,
    Econometrica 1982): other things than clocks pull differently at different times and places.

    Args:
        seen: With 1; with -1 where time ran back.
        gap: Between moments, in the scene's time.
    """
    cameras = len(next(iter(seen.values())).now)
    prior, none = np.eye(cameras) / (BEFORE * gap) ** 2, np.zeros(cameras)
    blocks = [Block(b.information, sign * b.pull) for sign, one in seen.items() for b in one.blocks.values()]
    covariance = np.linalg.inv(sum((b.information for b in blocks), prior))
    offset = covariance @ sum((b.pull for b in blocks), none)
    from_mean = np.eye(cameras) - 1 / cameras
    differ = [from_mean @ covariance @ (b.pull - b.information @ offset) for b in blocks]
    by_error = (from_mean @ covariance @ from_mean.T).diagonal()
    by_blocks = np.square(differ).sum(0) * len(blocks) / max(len(blocks) - 1, 1) if blocks else none
    return offset - np.median(offset), np.sqrt(np.maximum(by_error, by_blocks))


def offsets_to_follow(times_followed: Sequence[Mapping[int, Offsets]], gap: float) -> Float[np.ndarray, " c"]:
    """Those offsets that are worth to follow, the others 0, as clocks say; all 0 where none is clear.

    Where one camera is late, tracks lie between it and the others, and one that sees things from where it does seems
    to be early: perhaps by as much, but not for certain.

    Args:
        times_followed: What was seen each time that everything was followed, with other offsets each time, as
            `offsets_of` takes it. Tracks hide a share of what is left of an offset; two times tell which.
        gap: Between moments, in the scene's time.
    """
    *before, last = (_Told(_used(seen), *offsets_of(seen, gap)) for seen in times_followed[-2:])
    share = _share_shown(before[-1], last) if before else 1.0
    hidden = (last.offsets - last.used) * (1 / share - 1)
    offsets, std = last.offsets + hidden - np.median(hidden), last.std / share
    is_clear = np.abs(offsets) > np.maximum(CLEAR * gap, SIGMAS * std)
    return np.where(is_clear.any() & (np.abs(offsets) > LIKELY * std), offsets, 0.0)


class _Told(NamedTuple):
    """What following everything once says of offsets: those that were used, those that were found, their deviations."""

    used: Float[np.ndarray, " c"]
    offsets: Float[np.ndarray, " c"]
    std: Float[np.ndarray, " c"]

    def left(self) -> Float[np.ndarray, " c"]:
        """What it finds beyond those that were used."""
        return _from_mean(self.offsets - self.used)


def _share_shown(before: _Told, after: _Told) -> float:
    """The share of what is left of offsets that following shows: by how much less it found after some were used."""
    went = _from_mean(after.used - before.used)
    share = went @ (before.left() - after.left()) / max(went @ went, 1e-30)
    return float(np.clip(share, LEAST_SHOWN, 1.0))


def _used(seen: Mapping[int, Offsets]) -> Float[np.ndarray, " c"]:
    sign, one = next(iter(seen.items()))
    return sign * one.now


def _from_mean(offsets: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
    return offsets - offsets.mean()
