"""Where a graph has been, moment by moment."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from devrf.reconstruct.tracking.runs import Arrays
from devrf.reconstruct.tracking.solver.graph import Graph, Pose

SEEK_EVERY = 4  # moments


class Trajectory:
    """Poses of a graph so far, and what is lost.

    Attributes:
        graph: That moves.
        times: Of all moments, evenly spaced; at the first it rests [t].
        gap: Between two.
        poses: At each moment so far.
        lost: Nodes that pictures do not show, at each [n].
        xyz: The points, at each [p, 3].
        sought: Moment at which what is lost was last sought in vain.
    """

    def __init__(self, graph: Graph, times: Float[np.ndarray, " t"]) -> None:
        """At rest."""
        self.graph, self.times, self.sought = graph, times, -SEEK_EVERY
        self.gap = float(times[1] - times[0]) if len(times) > 1 else 1.0
        self.poses, self.xyz = [Pose.rest(len(graph.nodes))], [graph.surface.xyz]
        self.lost = [np.zeros(len(graph.nodes), dtype=bool)]

    @property
    def coming(self) -> int:
        """Number of the moment that comes."""
        return len(self.xyz)

    def add(self, pose: Pose, lost: Bool[np.ndarray, " n"]) -> None:
        """The pose at the next moment, and nodes that are lost there."""
        self.poses.append(pose)
        self.lost.append(lost)
        self.xyz.append(self.graph.points(pose))
        if len(self.xyz) > 2:  # moments are worked out from the two before: the others are only results
            self.xyz[-3] = self.xyz[-3].astype(np.float32)

    def at(self, time: float) -> Float[np.ndarray, "p 3"]:
        """All points at a time that has been, or soon comes: on the way between the two moments around it."""
        first = int(np.ceil((time - self.times[0]) / self.gap - 1e-6)) - 1
        first = min(max(first, 0), max(len(self.xyz) - 2, 0))
        was, now = self.xyz[first], self.xyz[min(first + 1, len(self.xyz) - 1)]
        # Before the first moment they were at rest.
        share = max(0.0, 1 + (time - float(self.times[first + 1])) / self.gap)
        return was + share * (now - was)

    def ahead(self) -> Pose:
        """The pose that comes if everything goes on as it went."""
        before, now = [self.poses[0], *self.poses][-2:]
        turn = now.rotations @ before.rotations.transpose(0, 2, 1)
        rotations = Rotation.from_matrix(turn @ now.rotations).as_matrix()  # a rotation again, to all digits
        return Pose(rotations, 2 * now.shifts - before.shifts)

    def state(self) -> Arrays:
        """All of it."""
        return {
            "rotations": np.stack([pose.rotations for pose in self.poses]),
            "shifts": np.stack([pose.shifts for pose in self.poses]),
            "lost": np.stack(self.lost),
            "sought": np.array(self.sought),
        }

    def take_up(self, state: Arrays) -> None:
        """Go on from a `state`, at rest so far."""
        after = (state[name][1:] for name in ("rotations", "shifts", "lost"))
        for rotations, shifts, lost in zip(*after, strict=True):
            self.add(Pose(rotations, shifts), lost)
        self.sought = int(state["sought"])
