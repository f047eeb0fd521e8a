"""What is lost is looked for again, and carried along by what is around it until it is found.

It is looked for from other guesses: beside its neighbours as at rest or as it was before, and as far away as flow finds
it.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from devrf.reconstruct.tracking.lost.joint_search import turn_limbs
from devrf.reconstruct.tracking.pose import FARTHER, STEPS, Estimate, Shots
from devrf.reconstruct.tracking.rigid import motion_of, residual
from devrf.reconstruct.tracking.solver.graph import Pose
from devrf.reconstruct.tracking.trajectory import SEEK_EVERY, Trajectory

FEWEST_LOST = 2  # nodes for which other guesses are tried
AGAIN = 0.1  # likeness that another guess must bring
AS_ONE = 0.15  # edge lengths: nodes that one motion leaves farther off than this do not move as one
ALONG = 0.9  # of its way: a thing is less off where what is near would have taken it; a ball that rolls past is not
AROUND, FEWEST_AROUND = 3, 4  # rings of nodes by which a lost node is carried along; fewest nodes of these


def look_again(shots: Shots, found: Estimate, expected: Pose) -> None:
    """Where something is lost, change the estimate where another guess leads to what pictures show.

    What is not found by that is looked for again only some moments later, all of it at once, or together with what is
    lost then: looking takes long.
    """
    past, graph = shots.past, shots.graph
    new = found.lost & ~past.lost[-1]
    due = past.coming - past.sought >= SEEK_EVERY or new.sum() >= FEWEST_LOST
    if due and found.lost.sum() >= FEWEST_LOST:
        asked = graph.points_of(found.lost)
        for guess in _guesses(shots, found, expected):
            other = shots.fit(found.pose.with_nodes(np.flatnonzero(found.lost), guess), FARTHER, asked)
            liked = shots.likeness(other)
            for group in graph.groups(found.lost):
                if _more(liked[group], found.likeness[group]) > AGAIN:
                    found.pose = found.pose.with_nodes(group, other)
                    found.likeness[group] = liked[group]
            found.see(found.likeness)
            if not found.lost.any():
                break
        if found.lost.any():
            past.sought = past.coming
    if found.lost.any():
        found.pose = _carried_if_better(shots, found)
        if due:
            turn_limbs(shots, found)


def _guesses(shots: Shots, found: Estimate, expected: Pose) -> Iterator[Pose]:
    """Where what is lost may be, each when it is asked for: beside what is around, as at rest or as before; gone far.

    How far anything went only flow from where it was tells: nothing of what was lost before.
    """
    past = shots.past
    yield carried(past, found.pose, found.lost, past.poses[0])
    yield carried(past, found.pose, found.lost, past.poses[-1])
    if (found.lost & ~past.lost[-1]).any():
        yield _gone_far(shots, expected)


def _gone_far(shots: Shots, expected: Pose) -> Pose:
    """The pose to which everything comes from the pictures before, if it came far."""
    shots.come(far=True)
    far = expected
    for _ in range(2 * STEPS):
        far = shots.step(far, expected)
    return far


def _carried_if_better(shots: Shots, found: Estimate) -> Pose:
    """The pose with what is lost carried along as it was before; as at rest, or as found, where pictures show more."""
    past, lost = shots.past, found.lost
    out = carried(past, found.pose, lost, past.poses[-1])
    liked = shots.likeness(out)
    as_at_rest = carried(past, found.pose, lost, past.poses[0])
    for other, likeness in ((as_at_rest, shots.likeness(as_at_rest)), (found.pose, found.likeness)):
        for group in shots.graph.groups(lost):
            if _more(likeness[group], liked[group]) > 0:
                out = out.with_nodes(group, other)
                liked[group] = likeness[group]
    return out


def carried(past: Trajectory, pose: Pose, lost: Bool[np.ndarray, " n"], since: Pose) -> Pose:
    """The pose with what is lost beside the nodes around it as in an earlier pose, `since`, if these have gone as one
    since then; else as it is.

    Beside them as at rest is right for what is a piece of them, whatever has pulled at it; as before for a limb that
    has gone a way of its own. Around are neighbours in the graph; of what has hardly any, what it was near to and went
    along with.
    """
    graph, out = past.graph, pose
    before, now = (graph.nodes + one.shifts for one in (since, pose))
    for group in graph.groups(lost):
        for rings in range(AROUND, 0, -1):
            around = np.flatnonzero(graph.around(group, rings) & ~lost)
            if len(around) < FEWEST_AROUND:
                around = _gone_along_with(past, group, lost, rings)
            if len(around) < FEWEST_AROUND:
                break
            there = now[None, around]
            motion = motion_of(before[around], there)
            if residual(motion, before[around], there).mean() < (AS_ONE * graph.edge) ** 2:
                rotations, shifts, ((rotation,), (shift,)) = out.rotations.copy(), out.shifts.copy(), motion
                rotations[group] = rotation @ since.rotations[group]
                shifts[group] = before[group] @ rotation.T + shift - graph.nodes[group]
                out = Pose(rotations, shifts)
                break
    return out


def _gone_along_with(
    past: Trajectory, group: Int[np.ndarray, " k"], lost: Bool[np.ndarray, " n"], edges: int
) -> Int[np.ndarray, " m"]:
    """Nodes within so many mean edge lengths of some nodes at rest that are not lost; none if the latter, when they
    were seen last, were elsewhere than these had taken them."""
    nodes = past.graph.nodes
    away = np.asarray(KDTree(nodes[group]).query(nodes)[0])
    near = np.flatnonzero((away < edges * past.graph.edge) & ~lost)
    if len(near) < FEWEST_AROUND:
        return near
    seen = max(moment for moment, lost_then in enumerate(past.lost) if not lost_then[group].any())
    there = nodes + past.poses[seen].shifts
    (rotation,), (shift,) = motion_of(nodes[near], there[None, near])
    taken = nodes[group] @ rotation.T + shift
    off, way = (np.linalg.norm(there[group] - x, axis=1).mean() for x in (taken, nodes[group]))
    return near if off < ALONG * way else near[:0]


def _more(liked: Float[np.ndarray, " k"], before: Float[np.ndarray, " k"]) -> float:
    """By how much more pictures show of some nodes than before, in the mean; NaN where nothing is known of them."""
    known = np.isfinite(liked) & np.isfinite(before)
    return float(liked[known].mean() - before[known].mean()) if known.any() else np.nan
