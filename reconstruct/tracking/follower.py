"""Where points are, moment by moment: the graph's pose, and what it needs to go on.

At each moment the graph's pose is predicted (constant velocity) and moved by Gauss-Newton steps to what the cameras
show: optical flow from the picture before, flow from the drawn prediction to the picture, and the brightness of
high-pass pictures itself. Points are always compared with real pictures, mostly of the rest, so errors do not add up.
Pictures count at their exact times: a point of a picture at time t lies on the way between the two moments around it.

Where pictures show what stands behind instead of a node's points, the node is lost. What pictures seem to want of its
points is then mostly chance, and would pull what is around, too: it only counts where all that hangs together is lost.
The node is looked for again from other guesses: carried along by what is around it, where it was, and as far away as
flow finds it; until it is found it is carried along.
"""

from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from devrf.reconstruct.tracking.cross_validation import CrossValidation
from devrf.reconstruct.tracking.offsets import FEWEST_CAMERAS, Offsets
from devrf.reconstruct.tracking.rigid import motion_of, residual
from devrf.reconstruct.tracking.runs import Arrays
from devrf.reconstruct.tracking.solver.graph import Graph, Pose, pieces
from devrf.reconstruct.tracking.solver.quadratics import Sum
from devrf.reconstruct.tracking.solver.solve import step
from devrf.reconstruct.tracking.surface import Surface
from devrf.reconstruct.tracking.views.film import Film
from devrf.reconstruct.tracking.views.shot import Shot
from devrf.reconstruct.tracking.views.sight import Sight
from devrf.reconstruct.tracking.views.templates import Templates

SIGMAS = (
    (2.5, 1.2),
    (1.2, 0.0),
)  # pixels by which pictures are blurred, each time the prediction is drawn anew
FARTHER = ((5.0, 2.5), (1.2, 0.0))  # the same where something is looked for again
STEPS = 2  # of Gauss-Newton, of each
LEARN_EVERY, SEEK_EVERY = 4, 4  # moments
LEFT_OUT = 24  # pictures of each camera at least, where it has as many: neighbours tell the same
LOST, AGAIN = 0.25, 0.1  # likeness below which a node is lost; how much more another guess must bring
FEWEST_LOST = 2  # nodes for which other guesses are tried
AS_ONE = 0.15  # edge lengths: nodes that one motion leaves farther off than this do not move as one
TELLING = 1.0  # weight of points by which a node's likeness is known
ALONG = 0.9  # of its way: a thing is less off where what is near would have taken it; a ball that rolls past is not
AROUND, FEWEST_AROUND = 3, 4  # rings of nodes by which a lost node is carried along; fewest nodes of these


class Follower:
    """Where the graph is, moment by moment."""

    def __init__(
        self,
        surface: Surface,
        graph: Graph,
        films: Sequence[Film],
        times: Float[np.ndarray, " t"],
        offsets: Offsets,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.surface, self.graph, self.times = surface, graph, times
        self.offsets, self.pool, self.left_out = offsets, pool, CrossValidation()
        self.gap = float(times[1] - times[0]) if len(times) > 1 else 1.0
        self.poses = [Pose.rest(len(graph.nodes))]
        a, b = graph.nodes[graph.edges].transpose(1, 0, 2)
        self.edge = float(np.linalg.norm(b - a, axis=1).mean()) if len(a) else 0.0
        self.lost_nodes = np.zeros(len(graph.nodes), dtype=bool)
        self.nodes_lost = [self.lost_nodes]  # at each moment
        self.sought = -SEEK_EVERY  # moment at which what is lost was last sought in vain
        self.xyz, self.lost = [surface.xyz], [np.zeros(len(surface), dtype=bool)]
        self.templates = [Templates(film, len(surface)) for film in films]
        for known in self.templates:
            n = known.film.nearest(times[0], self.gap)
            if n is not None:
                known.learn(n, Sight(known.film, surface.xyz, surface.normals, surface.spacing), 1)

    def go_on(self, moment: int) -> None:
        """To the next moment."""
        graph, surface, shots = self.graph, self.surface, self.shots(moment)
        self._come(shots, moment)
        expected = self.carried(_ahead(*[self.poses[0], *self.poses][-2:]), self.lost_nodes)
        found = expected
        if len(shots) >= FEWEST_CAMERAS:
            found = self.found(shots, expected, SIGMAS, believed=self._believed())
            likeness = self.likeness(shots, found)
            self.lost_nodes = self._lost(likeness)
            self._time(shots, found)
            self._leave_out(shots, found, expected)
            found = self._found_again(shots, found, expected, likeness, moment)
        self._come_to(found, self.lost_nodes)
        was, now = self.xyz[-2:]
        if moment % LEARN_EVERY == 0:
            normals = graph.turned(found, surface.normals)
            for shot in shots:
                sight = Sight(shot.film, was + shot.share * (now - was), normals, surface.spacing)
                sight.seen &= ~self.lost[-1]
                shot.templates.learn(shot.n, sight)

    def _come_to(self, pose: Pose, lost: Bool[np.ndarray, " n"]) -> None:
        self.poses.append(pose)
        self.nodes_lost.append(lost)
        self.xyz.append(self.graph.points(pose))
        if len(self.xyz) > 2:  # moments are worked out from the two before: the others are only results
            self.xyz[-3] = self.xyz[-3].astype(np.float32)
        self.lost.append(self._points(lost))

    def state(self) -> Arrays:
        """Everything that the next moment depends on."""
        out = {
            "rotations": np.stack([pose.rotations for pose in self.poses]),
            "shifts": np.stack([pose.shifts for pose in self.poses]),
            "lost": np.stack(self.nodes_lost),
            "sought": np.array(self.sought),
        }
        for camera, known in enumerate(self.templates):
            out |= {f"picture {camera}": known.picture, f"at {camera}": known.at}
        return out | self.offsets.state() | self.left_out.state()

    def take_up(self, state: Arrays) -> None:
        """Go on from a `state`, right after the beginning."""
        after = (state[name][1:] for name in ("rotations", "shifts", "lost"))
        for rotations, shifts, lost in zip(*after, strict=True):
            self._come_to(Pose(rotations, shifts), lost)
        self.lost_nodes, self.sought = self.nodes_lost[-1], int(state["sought"])
        for camera, known in enumerate(self.templates):
            known.picture, known.at = state[f"picture {camera}"].copy(), state[f"at {camera}"].copy()
        self.offsets.take_up(state)
        self.left_out.take_up(state)

    def shots(self, moment: int) -> list[Shot]:
        """The pictures around a moment."""
        time, out = self.times[moment], []
        for camera, known in enumerate(self.templates):
            late = self.offsets.now[camera]
            n = known.film.nearest(time - late, self.gap / 2 + 1e-9)
            if n is not None:
                out.append(Shot(camera, known, n, 1 + (float(known.film.times[n]) + late - time) / self.gap))
        return out

    def _come(self, shots: Sequence[Shot], moment: int, far: bool = False) -> None:
        """Where points come from pictures at the moment before, or from the last ones; `far`: by flow that finds longer
        ways."""
        normals, known = self.graph.turned(self.poses[-1], self.surface.normals), ~self.lost[-1]
        begun = []
        for shot in shots:
            late = self.offsets.now[shot.camera]
            at_moment = shot.film.nearest(self.times[moment - 1] - late, self.gap / 2 + 1e-9)
            begin = shot.n - 1 if at_moment is None else min(at_moment, shot.n - 1)
            if begin >= 0:
                at = self._where(float(shot.film.times[begin]) + late)
                begun.append(
                    self.pool.submit(shot.come, begin, at, normals, self.surface.spacing, known, far)
                )
        _each(begun)

    def _where(self, time: float) -> Float[np.ndarray, "p 3"]:
        """All points at a time that has been, or soon comes: on the way between the two moments around it."""
        first = int(np.ceil((time - self.times[0]) / self.gap - 1e-6)) - 1
        first = min(max(first, 0), max(len(self.xyz) - 2, 0))
        was, now = self.xyz[first], self.xyz[min(first + 1, len(self.xyz) - 1)]
        share = max(
            0.0, 1 + (time - float(self.times[first + 1])) / self.gap
        )  # before the first they were at rest
        return was + share * (now - was)

    def found(
        self,
        shots: Sequence[Shot],
        expected: Pose,
        rounds: Sequence[tuple[float, float]],
        asked: Bool[np.ndarray, " p"] | None = None,
        believed: Bool[np.ndarray, " p"] | None = None,
    ) -> Pose:
        """The pose that explains the pictures, near the one that is expected.

        Args:
            shots: Of one moment.
            expected: From where it begins.
            rounds: Blur of pictures, in pixels, each time the prediction is drawn anew.
            asked: Only what is around these points is looked at; None: all pictures.
            believed: What pictures want of other points does not count; None: all count.
        """
        graph, surface, now, found = self.graph, self.surface, self.xyz[-1], expected
        for number, sigmas in enumerate(rounds):
            xyz, again = graph.points(found), number > 0
            normals = graph.turned(found, surface.normals)
            _each(
                self.pool.submit(
                    shot.look, now + shot.share * (xyz - now), normals, surface, sigmas, asked, again
                )
                for shot in shots
            )
            for _ in range(STEPS):
                found = self._step(shots, found, expected, believed)
        return found

    def _step(
        self,
        shots: Sequence[Shot],
        found: Pose,
        expected: Pose,
        believed: Bool[np.ndarray, " p"] | None = None,
    ) -> Pose:
        """A little nearer to what the pictures show."""
        now, xyz, pulls = self.xyz[-1], self.graph.points(found), Sum(len(self.surface))
        for shot in shots:
            shot.pull(now + shot.share * (xyz - now), pulls)
        return step(self.graph, found, expected, pulls.of(believed))

    def _time(self, shots: Sequence[Shot], found: Pose) -> None:
        """See where along their way the cameras show points that are not lost."""
        was, known = self.xyz[-1], ~self._points(self.lost_nodes)
        way = self.graph.points(found) - was
        self.offsets.add({s.camera: s.shown(was + s.share * way, known) for s in shots}, way, self.gap)

    def _leave_out(self, shots: Sequence[Shot], found: Pose, expected: Pose) -> None:
        """Hold pictures against points where the others alone want them: one more step, without what one pulls."""
        asked = [shot for shot in shots if shot.n % max(1, len(shot.film.times) // LEFT_OUT) == 0]
        if not asked:
            return
        now, xyz, believed = self.xyz[-1], self.graph.points(found), self._believed()
        pulls = [Sum(len(self.surface)) for _ in shots]
        for shot, own in zip(shots, pulls, strict=True):
            shot.pull(now + shot.share * (xyz - now), own)
        for shot, own in zip(shots, pulls, strict=True):
            if shot not in asked:
                continue
            others = Sum(len(self.surface))
            for other in pulls:
                if other is not own:
                    others.join(other)
            seen = np.asarray(others.hessian.any((1, 2)))
            placed = self.graph.points(step(self.graph, found, expected, others.of(believed)))
            points, likeness = shot.likeness(now + shot.share * (placed - now))
            number, time = shot.film.frames[shot.n].index, abs(float(shot.film.times[shot.n]))
            self.left_out.add(shot.camera, number, time, likeness[seen[points]])

    def _found_again(
        self,
        shots: Sequence[Shot],
        found: Pose,
        expected: Pose,
        likeness: Float[np.ndarray, " n"],
        moment: int,
    ) -> Pose:
        """The same where nothing is lost; else with what is lost where another guess leads to what pictures show.

        What is not found by that is looked for again only some moments later, all of it at once, or together with what
        is lost then: looking takes long.
        """
        new = self.lost_nodes & ~self.nodes_lost[-1]
        due = moment - self.sought >= SEEK_EVERY or new.sum() >= FEWEST_LOST
        if due and self.lost_nodes.sum() >= FEWEST_LOST:
            asked = self._points(self.lost_nodes)
            for guess in self._guesses(shots, found, expected, moment):
                begin = _with(found, guess, np.flatnonzero(self.lost_nodes))
                other = self.found(shots, begin, FARTHER, asked)
                liked = self.likeness(shots, other)
                for group in self._groups(self.lost_nodes):
                    if _more(liked[group], likeness[group]) > AGAIN:
                        found = _with(found, other, group)
                        likeness[group] = liked[group]
                self.lost_nodes = self._lost(likeness)
                if not self.lost_nodes.any():
                    break
            if self.lost_nodes.any():
                self.sought = moment
        return self._carried_if_better(shots, found, likeness)

    def _guesses(self, shots: Sequence[Shot], found: Pose, expected: Pose, moment: int) -> Iterator[Pose]:
        """Where what is lost may be, each when it is asked for: carried along, where it was, gone far.

        How far anything went only flow from where it was tells: nothing of what was lost before.
        """
        yield self.carried(found, self.lost_nodes)
        yield self.poses[-1]
        if (self.lost_nodes & ~self.nodes_lost[-1]).any():
            yield self._gone_far(shots, expected, moment)

    def _gone_far(self, shots: Sequence[Shot], expected: Pose, moment: int) -> Pose:
        """The pose to which everything comes from the pictures before, if it came far."""
        self._come(shots, moment, far=True)
        far = expected
        for _ in range(2 * STEPS):
            far = self._step(shots, far, expected)
        return far

    def _carried_if_better(
        self, shots: Sequence[Shot], found: Pose, likeness: Float[np.ndarray, " n"]
    ) -> Pose:
        """The pose with what is lost carried along, but for what pictures then show even less of."""
        if not self.lost_nodes.any():
            return found
        out = self.carried(found, self.lost_nodes)
        liked = self.likeness(shots, out)
        for group in self._groups(self.lost_nodes):
            if _more(liked[group], likeness[group]) < 0:
                out = _with(out, found, group)
        return out

    def likeness(self, shots: Sequence[Shot], found: Pose) -> Float[np.ndarray, " n"]:
        """Of what pictures show to the points of each node: 1 alike, -1 what stands behind; NaN not known."""
        graph, now = self.graph, self.xyz[-1]
        xyz = graph.points(found)
        sums = np.zeros((2, len(graph.nodes)))
        for shot in shots:
            points, votes = shot.likeness(now + shot.share * (xyz - now))
            weights = graph.weights[points]
            np.add.at(sums[0], graph.followed[points], weights * votes[:, None])
            np.add.at(sums[1], graph.followed[points], weights)
        return np.where(sums[1] > TELLING, sums[0] / np.maximum(sums[1], 1e-9), np.nan)

    def _believed(self) -> Bool[np.ndarray, " p"]:
        """Points that are not lost, and those of things that are lost as a whole."""
        piece = self.graph.piece
        seen = np.bincount(piece, ~self.lost_nodes)[piece] > 0
        return ~self._points(self.lost_nodes & seen)

    def _points(self, nodes: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " p"]:
        """Points that mostly follow some nodes."""
        return (self.graph.weights * nodes[self.graph.followed]).sum(1) > 0.5

    def _lost(self, likeness: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Nodes that pictures do not show; those of which nothing is known stay what they were."""
        return np.where(np.isfinite(likeness), likeness < LOST, self.lost_nodes)

    def _groups(self, lost: Bool[np.ndarray, " n"]) -> Iterator[Int[np.ndarray, " k"]]:
        """Lost nodes that are neighbours."""
        pairs = self.graph.edges
        piece = pieces(pairs[lost[pairs].all(1)], len(lost))
        for number in np.unique(piece[lost]):
            yield np.flatnonzero(lost & (piece == number))

    def carried(self, pose: Pose, lost: Bool[np.ndarray, " n"]) -> Pose:
        """The pose with what is lost as the nodes around it have gone, where these have gone as one; else as it is.

        Around are its neighbours in the graph; of what has hardly any, what it was near to and went along with.
        """
        nodes, out = self.graph.nodes, pose
        for group in self._groups(lost):
            for rings in range(AROUND, 0, -1):
                around = self._around(group, lost, rings)
                if len(around) < FEWEST_AROUND:
                    around = self._gone_along_with(group, lost, rings)
                there = (nodes + pose.shifts)[None, around]
                if len(around) < FEWEST_AROUND:
                    break
                motion = motion_of(nodes[around], there)
                if residual(motion, nodes[around], there).mean() < (AS_ONE * self.edge) ** 2:
                    rotations, shifts = out.rotations.copy(), out.shifts.copy()
                    rotations[group] = motion[0][0]
                    shifts[group] = nodes[group] @ motion[0][0].T + motion[1][0] - nodes[group]
                    out = Pose(rotations, shifts)
                    break
        return out

    def _around(
        self, group: Int[np.ndarray, " k"], lost: Bool[np.ndarray, " n"], rings: int
    ) -> Int[np.ndarray, " m"]:
        """Nodes within so many edges of some nodes that are not lost."""
        a, b = self.graph.edges.T
        near = np.isin(np.arange(len(lost)), group)
        for _ in range(rings):
            near[b[near[a]]] = True
        return np.flatnonzero(near & ~lost)

    def _gone_along_with(
        self, group: Int[np.ndarray, " k"], lost: Bool[np.ndarray, " n"], edges: int
    ) -> Int[np.ndarray, " m"]:
        """Nodes within so many mean edge lengths of some nodes at rest that are not lost; none if the latter, when they
        were seen last, were elsewhere than these had taken them."""
        nodes = self.graph.nodes
        away = np.asarray(KDTree(nodes[group]).query(nodes)[0])
        near = np.flatnonzero((away < edges * self.edge) & ~lost)
        if len(near) < FEWEST_AROUND:
            return near
        seen = max(moment for moment, lost_then in enumerate(self.nodes_lost) if not lost_then[group].any())
        there = nodes + self.poses[seen].shifts
        (rotation,), (shift,) = motion_of(nodes[near], there[None, near])
        taken = nodes[group] @ rotation.T + shift
        off, way = (np.linalg.norm(there[group] - x, axis=1).mean() for x in (taken, nodes[group]))
        return near if off < ALONG * way else near[:0]


def _more(liked: Float[np.ndarray, " k"], before: Float[np.ndarray, " k"]) -> float:
    """By how much more pictures show of some nodes than before, in the mean; NaN where nothing is known of them."""
    known = np.isfinite(liked) & np.isfinite(before)
    return float(liked[known].mean() - before[known].mean()) if known.any() else np.nan


def _with(pose: Pose, other: Pose, nodes: Int[np.ndarray, " k"]) -> Pose:
    """A pose in which some nodes are as in another."""
    rotations, shifts = pose.rotations.copy(), pose.shifts.copy()
    rotations[nodes], shifts[nodes] = other.rotations[nodes], other.shifts[nodes]
    return Pose(rotations, shifts)


def _each(begun: Iterable[Future[None]]) -> None:
    """Wait for pictures of different cameras, which are looked at side by side."""
    for done in list(begun):
        done.result()


def _ahead(before: Pose, now: Pose) -> Pose:
    """The pose that comes if everything goes on as it went."""
    turn = now.rotations @ before.rotations.transpose(0, 2, 1)
    rotations = Rotation.from_matrix(turn @ now.rotations).as_matrix()  # a rotation again, to all digits
    return Pose(rotations, 2 * now.shifts - before.shifts)
