"""The pose that explains the pictures of one moment, and which nodes they do not show.

Gauss-Newton steps from an expected pose to what the cameras show: optical flow from the picture before, flow from the
drawn prediction to the picture, and the brightness of high-pass pictures itself. Pictures count at their exact times: a
point of a picture at time t lies on the way between the two moments around it.

What pictures seem to want of points that are lost is mostly chance, and would pull what is around, too: it only counts
where all that hangs together is lost.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from devrf.reconstruct.tracking.solver.graph import Graph, Pose
from devrf.reconstruct.tracking.solver.quadratics import Sum
from devrf.reconstruct.tracking.solver.solve import step
from devrf.reconstruct.tracking.trajectory import Trajectory
from devrf.reconstruct.tracking.views.film import CameraFilm
from devrf.reconstruct.tracking.views.shot import Shot
from devrf.reconstruct.tracking.views.templates import Templates

FARTHER = (5.0, 2.5), (1.2, 0.0)  # pixels by which pictures are blurred, as what is lost is fitted
STEPS = 2  # of Gauss-Newton, each time that the prediction is drawn
LOST = 0.25  # likeness below which a node is lost
TELLING = 1.0  # weight of points by which a node's likeness is known


@dataclass
class Estimate:
    """Where the graph seems to be at a moment.

    Attributes:
        pose: Of its nodes.
        lost: Nodes that pictures do not show [n].
        likeness: Of pictures to the points of each node: 1 alike, -1 what stands behind; NaN not known [n].
    """

    pose: Pose
    lost: Bool[np.ndarray, " n"]
    likeness: Float[np.ndarray, " n"]

    def see(self, likeness: Float[np.ndarray, " n"]) -> None:
        """Tell what is lost by a likeness; what nothing is known of stays what it was."""
        self.lost = np.where(np.isfinite(likeness), likeness < LOST, self.lost)
        self.likeness = likeness


class Shots:
    """The pictures around the moment that comes: one of each camera that has one.

    Attributes:
        past: Where the graph has been.
        late: By how much later each camera takes its pictures than their times say [c].
        all: What each picture says.
    """

    def __init__(
        self,
        past: Trajectory,
        templates: Sequence[Templates],
        late: Float[np.ndarray, " c"],
        pool: ThreadPoolExecutor,
    ) -> None:
        """Of each camera the picture that is nearest; they are looked at side by side in a pool."""
        self.past, self.graph, self.late, self.pool = past, past.graph, late, pool
        time, self.all = past.times[past.coming], list[Shot]()
        for camera, known in enumerate(templates):
            n = self._nearest(known.film, time - late[camera])
            if n is not None:
                share = 1 + (float(known.film.times[n]) + late[camera] - time) / past.gap
                self.all.append(Shot(camera, known, n, share, past.xyz[-1]))

    def _each(self, do: Callable[[Shot], None]) -> None:
        """Do something with each picture, side by side."""
        list(self.pool.map(do, self.all))

    def _nearest(self, film: CameraFilm, time: float) -> int | None:
        return film.nearest(time, self.past.gap / 2 + 1e-9)

    def come(self, far: bool = False) -> None:
        """See where points come from pictures at the moment before, or from the last ones; `far`: by flow that finds
        longer ways."""
        past, graph = self.past, self.graph
        surface, known = graph.posed(past.poses[-1]), ~graph.points_of(past.lost[-1])

        def one(shot: Shot) -> None:
            late = self.late[shot.camera]
            at_moment = self._nearest(shot.film, past.times[past.coming - 1] - late)
            begin = shot.n - 1 if at_moment is None else min(at_moment, shot.n - 1)
            if begin >= 0:
                there = replace(surface, xyz=past.at(float(shot.film.times[begin]) + late))
                shot.come(begin, there, known, far)

        self._each(one)

    def fit(
        self,
        expected: Pose,
        rounds: Sequence[tuple[float, float]],
        asked: Bool[np.ndarray, " p"] | None = None,
        believed: Bool[np.ndarray, " p"] | None = None,
    ) -> Pose:
        """The pose that explains the pictures, near the one that is expected.

        Args:
            expected: From where it begins.
            rounds: Blur of pictures, in pixels, each time the prediction is drawn anew.
            asked: Only what is around these points is looked at; None: all pictures.
            believed: What pictures want of other points does not count; None: all count.
        """
        found = expected
        for number, sigmas in enumerate(rounds):
            look = partial(
                Shot.look, surface=self.graph.posed(found), sigmas=sigmas, asked=asked, again=number > 0
            )
            self._each(look)
            for _ in range(STEPS):
                found = self.step(found, expected, believed)
        return found

    def step(self, found: Pose, expected: Pose, believed: Bool[np.ndarray, " p"] | None = None) -> Pose:
        """A little nearer to what the pictures show."""
        xyz, pulls = self.graph.points(found), Sum(len(self.graph.surface))
        for shot in self.all:
            shot.pull(xyz, pulls)
        return step(self.graph, found, expected, pulls.of(believed))

    def likeness(self, pose: Pose) -> Float[np.ndarray, " n"]:
        """Of what pictures show to the points of each node, as in `Estimate`."""
        graph, xyz = self.graph, self.graph.points(pose)
        sums = np.zeros((2, len(graph.nodes)))
        for shot in self.all:
            points, votes = shot.likeness(xyz)
            weights = graph.weights[points]
            np.add.at(sums[0], graph.followed[points], weights * votes[:, None])
            np.add.at(sums[1], graph.followed[points], weights)
        return np.where(sums[1] > TELLING, sums[0] / np.maximum(sums[1], 1e-9), np.nan)


def believed(graph: Graph, lost: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " p"]:
    """Points that are not lost, and those of things that are lost as a whole."""
    seen = np.bincount(graph.piece, ~lost)[graph.piece] > 0
    return ~graph.points_of(lost & seen)
