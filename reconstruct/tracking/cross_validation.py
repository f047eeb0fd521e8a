"""How well tracks agree with pictures that do not pull at them.

What pulls at tracks agrees with them, right or wrong. So each camera is left out in turn (leave-one-out
cross-validation: Stone, Journal of the Royal Statistical Society B 36, 1974): points go where the other cameras alone
want them, and what its picture shows there is an honest error. Of two ways to follow points the better one is told by
it, before anything is trained.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool

from devrf.reconstruct.evaluation.paired import Gain, gain_within_clips
from devrf.reconstruct.tracking.pose import Shots
from devrf.reconstruct.tracking.solver.graph import Pose
from devrf.reconstruct.tracking.solver.quadratics import Sum
from devrf.reconstruct.tracking.solver.solve import step

FEWEST_POINTS = 20  # of a picture that are worth a mean
LEFT_OUT = 24  # pictures of each camera at least, where it has as many: neighbours tell the same


class CrossValidation:
    """Likeness of pictures to points that the other cameras placed.

    Attributes:
        pictures: By camera and number in its clip when each was taken, in the scene's time of [0, 1], and its likeness,
            a mean over points; 1: it shows them, -1: it shows what stands behind them.
    """

    def __init__(self) -> None:
        """Nothing has been left out."""
        self.pictures: dict[tuple[int, int], tuple[float, float]] = {}

    def leave_out(self, shots: Shots, found: Pose, expected: Pose, believed: Bool[np.ndarray, " p"]) -> None:
        """Hold pictures against points where the others alone want them: one more step, without what one pulls.

        Args:
            shots: Of one moment.
            found, expected: Their pose, and where it was expected.
            believed: Points that pull.
        """
        asked = [shot for shot in shots.all if shot.n % max(1, len(shot.film.times) // LEFT_OUT) == 0]
        if not asked:
            return
        graph, xyz = shots.graph, shots.graph.points(found)
        pulls = {shot: Sum(len(xyz)) for shot in shots.all}
        for shot, own in pulls.items():
            shot.pull(xyz, own)
        for shot in asked:
            others = Sum(len(xyz))
            for other, own in pulls.items():
                if other is not shot:
                    others.join(own)
            seen = np.asarray(others.hessian.any((1, 2)))
            placed = graph.points(step(graph, found, expected, others.of(believed)))
            points, likeness = shot.likeness(placed)
            number, time = shot.film.frames[shot.n].index, abs(float(shot.film.times[shot.n]))
            self.add(shot.camera, number, time, likeness[seen[points]])

    def add(self, camera: int, number: int, time: float, likeness: np.ndarray) -> None:
        """What a picture shows of points [m] that the other cameras placed."""
        if len(likeness) >= FEWEST_POINTS:
            self.pictures[camera, number] = time, float(likeness.mean())

    def gain_over(self, other: "CrossValidation") -> Gain:
        """By how much pictures are more alike than by another way to follow, of those of both, with its interval."""
        both = [key for key in self.pictures if key in other.pictures]
        if not both:
            return Gain(0.0, None, ())
        times, mine = zip(*(self.pictures[key] for key in both), strict=True)
        theirs = [other.pictures[key][1] for key in both]
        return gain_within_clips(mine, theirs, [str(camera) for camera, _ in both], times)

    def with_those_of(self, other: "CrossValidation") -> "CrossValidation":
        """The pictures of both."""
        out = CrossValidation()
        out.pictures = self.pictures | other.pictures
        return out

    def state(self) -> dict[str, np.ndarray]:
        """What has been left out."""
        return {
            "left out": np.array(list(self.pictures), dtype=int).reshape(-1, 2),
            "likeness": np.array(list(self.pictures.values()), dtype=float).reshape(-1, 2),
        }

    def take_up(self, state: Mapping[str, np.ndarray]) -> None:
        """Go on from a `state`."""
        every = zip(state["left out"].tolist(), state["likeness"].tolist(), strict=True)
        self.pictures = {(camera, number): (time, likeness) for (camera, number), (time, likeness) in every}
