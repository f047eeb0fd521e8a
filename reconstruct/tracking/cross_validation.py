"""How well tracks agree with pictures that do not pull at them.

What pulls at tracks agrees with them, right or wrong. So each camera is left out in turn (leave-one-out
cross-validation: Stone, Journal of the Royal Statistical Society B 36, 1974): points go where the other cameras alone
want them, and what its picture shows there is an honest error. Of two ways to follow points the better one is told by
it, before anything is trained.
"""

from collections.abc import Mapping

import numpy as np

from devrf.reconstruct.paired import Gain, gain_within_clips

FEWEST_POINTS = 20  # of a picture that are worth a mean


class CrossValidation:
    """Likeness of pictures to points that the other cameras placed.

    Attributes:
        likeness: Mean over points of each picture, by camera and the picture's number in its clip; 1: it shows them,
            -1: it shows what stands behind them.
        times: When each was taken, in the scene's time of [0, 1].
    """

    def __init__(self) -> None:
        """Nothing has been left out."""
        self.likeness: dict[tuple[int, int], float] = {}
        self.times: dict[tuple[int, int], float] = {}

    def add(self, camera: int, number: int, time: float, likeness: np.ndarray) -> None:
        """What a picture shows of points [m] that the other cameras placed."""
        if len(likeness) >= FEWEST_POINTS:
            self.likeness[camera, number] = float(likeness.mean())
            self.times[camera, number] = time

    def gain_over(self, other: "CrossValidation") -> Gain:
        """By how much pictures are more alike than by another way to follow, of those of both, with its interval."""
        both = [key for key in self.likeness if key in other.likeness]
        if not both:
            return Gain(0.0, None, ())
        mine, theirs = ([one.likeness[key] for key in both] for one in (self, other))
        cameras = [str(camera) for camera, _ in both]
        return gain_within_clips(mine, theirs, cameras, [self.times[key] for key in both])

    def with_those_of(self, other: "CrossValidation") -> "CrossValidation":
        """The pictures of both."""
        out = CrossValidation()
        out.likeness, out.times = self.likeness | other.likeness, self.times | other.times
        return out

    def state(self) -> dict[str, np.ndarray]:
        """What has been left out."""
        return {
            "pictures": np.array(list(self.likeness), dtype=int).reshape(-1, 2),
            "likeness": np.array(list(self.likeness.values()), dtype=float),
            "times": np.array(list(self.times.values()), dtype=float),
        }

    def take_up(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a `state`."""
        keys = [(camera, number) for camera, number in state["pictures"].tolist()]
        self.likeness = dict(zip(keys, state["likeness"].tolist(), strict=True))
        self.times = dict(zip(keys, state["times"].tolist(), strict=True))
