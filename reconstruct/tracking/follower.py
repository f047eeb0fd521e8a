"""Where points are, moment by moment: the graph's pose, and what it needs to go on.

At each moment the graph's pose is predicted (constant velocity) and moved to what the cameras show (`pose.py`). Points
are always compared with real pictures, mostly of the rest, so errors do not add up. Where pictures show what stands
behind instead of a node's points, the node is lost, and looked for (`lost/recovery.py`).
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from devrf.reconstruct.tracking.cross_validation import CrossValidation
from devrf.reconstruct.tracking.lost.recovery import carried, look_again
from devrf.reconstruct.tracking.offsets import FEWEST_CAMERAS, Offsets
from devrf.reconstruct.tracking.pose import Estimate, Shots, believed
from devrf.reconstruct.tracking.runs import Arrays
from devrf.reconstruct.tracking.solver.graph import Graph
from devrf.reconstruct.tracking.trajectory import Trajectory
from devrf.reconstruct.tracking.views.film import CameraFilm
from devrf.reconstruct.tracking.views.sight import Sight
from devrf.reconstruct.tracking.views.templates import Templates

# Pixels by which pictures are blurred, each time the prediction is drawn anew.
SIGMAS = (2.5, 1.2), (1.2, 0.0)
LEARN_EVERY = 4  # moments


class Follower:
    """Follows a graph from moment to moment.

    Attributes:
        past: Where it has been.
        templates: How its points look, of each film.
        offsets: Of cameras' clocks, and what is seen of them.
        left_out: How well it agrees with pictures left out.
    """

    def __init__(
        self,
        graph: Graph,
        films: Sequence[CameraFilm],
        times: Float[np.ndarray, " t"],
        offsets: Offsets,
        pool: ThreadPoolExecutor,
    ) -> None:
        """At rest at the first of the times; `pool` looks at pictures side by side."""
        self.graph, self.offsets, self.pool = graph, offsets, pool
        self.past, self.left_out = Trajectory(graph, times), CrossValidation()
        self.templates = [Templates(film, len(graph.surface)) for film in films]
        for known in self.templates:
            n = known.film.nearest(times[0], self.past.gap)
            if n is not None:
                known.learn(n, Sight(known.film, graph.surface), 1)

    def go_on(self) -> None:
        """To the next moment."""
        past, graph, moment = self.past, self.graph, self.past.coming
        shots = self.shots()
        shots.come()
        lost = past.lost[-1]
        expected = carried(past, past.ahead(), lost, past.poses[-1])
        found = Estimate(expected, lost, np.full(len(lost), np.nan))
        if len(shots.all) >= FEWEST_CAMERAS:
            found.pose = shots.fit(expected, SIGMAS, believed=believed(graph, lost))
            found.see(shots.likeness(found.pose))
            self._see_clocks(shots, found)
            self.left_out.leave_out(shots, found.pose, expected, believed(graph, found.lost))
            look_again(shots, found, expected)
        past.add(found.pose, found.lost)
        if moment % LEARN_EVERY == 0:
            self._learn(shots)

    def shots(self) -> Shots:
        """The pictures around the next moment."""
        return Shots(self.past, self.templates, self.offsets.now, self.pool)

    def _see_clocks(self, shots: Shots, found: Estimate) -> None:
        """See where along their way the cameras show points that are not lost."""
        xyz, known = self.graph.points(found.pose), ~self.graph.points_of(found.lost)
        shown = {shot.camera: shot.shown(xyz, known) for shot in shots.all}
        self.offsets.add(shown, xyz - self.past.xyz[-1], self.past.gap)

    def _learn(self, shots: Shots) -> None:
        """Take templates of points that are seen for the first time."""
        surface = self.graph.posed(self.past.poses[-1])
        known = ~self.graph.points_of(self.past.lost[-1])
        for shot in shots.all:
            sight = shot.sight(surface)
            sight.seen &= known
            shot.templates.learn(shot.n, sight)

    def state(self) -> Arrays:
        """Everything that the next moment depends on."""
        out = self.past.state() | self.offsets.state() | self.left_out.state()
        for camera, known in enumerate(self.templates):
            out |= {f"picture {camera}": known.picture, f"at {camera}": known.at}
        return out

    def take_up(self, state: Arrays) -> None:
        """Go on from a `state`, right after the beginning."""
        for camera, known in enumerate(self.templates):
            known.picture, known.at = state[f"picture {camera}"].copy(), state[f"at {camera}"].copy()
        for part in (self.past, self.offsets, self.left_out):
            part.take_up(state)
