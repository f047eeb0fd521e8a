"""Which surface points move: one log-odds a point, by all pictures, and one cut of the surface.

A point that moves is gone for all cameras at once; one that stands is hidden from each camera for a time of its own, or
covered for all of them for a short time. Cameras are added up, and none has a veto. What is told alike from moment to
moment counts once. Labels are a minimum cut (Boykov and Kolmogorov, PAMI 2004) on the surface, in which neighbours of
one plane and colour belong together.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import KDTree
from scipy.special import expit, logsumexp

from devrf.reconstruct.tracking.likelihoods import Likelihoods, likelihoods
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.views.film import CameraFilm

ALIKE = 6.0  # moments that tell as much as one that is independent: what lies in the shade stays in it
GONE = (0.5, 0.7, 0.9)  # shares of the busy time for which what moves may be away
AT_HOME = 0.05  # share of moments in which it is hidden while it is where it rests
# Shares of the time for which one camera may not see what stands, and how often each; the same for all cameras at once,
# of the busy time: what passes along covers a place.
HIDDEN, HOW_OFTEN_HIDDEN = (0.02, 0.3, 0.8), (0.9, 0.06, 0.04)
COVERED, HOW_OFTEN_COVERED = (0.1, 0.3), (0.06, 0.04)
PRIOR = -2.5  # log-odds of motion
# The same of points in one of a few planes, of whose points as many stand as are so much of the surface: floor that is
# covered for long looks as if it had gone. (Such planes hold 0.10 to 0.20 in five captures; edges of a sheet that fills
# its box, which stand by mistake, 0.03.)
IN_PLANE, PLANE_SHARE, MOST_PLANES, LEVEL = -3.0, 0.05, 4, 0.8
PLANES_TRIED = 200
MOST = 6.0  # log-odds of one point
NEIGHBOURS, REACH, COLOUR_REACH = 12, 2.25, 0.3  # number; spacings; of the full range
TOGETHER = 10.0  # log-odds that agreeing with all neighbours is worth
CREASE, FLAT = 0.003, 0.5  # of that, across a crease; spacings off each other's plane
# Fewer points than these, nearer than so many spacings, follow their surroundings, if they have any.
CRUMB, CRUMB_REACH = 60, 2.5
UNIT = 1000  # of weights, which are whole numbers in the cut


def moving_points(
    surface: SurfacePoints, films: Sequence[CameraFilm], rest_time: float
) -> Bool[np.ndarray, " n"]:
    """Whether each point moves.

    Args:
        surface: At rest.
        films: Of the fixed cameras; what stands in them is not looked at.
        rest_time: Of the scene, in [0, 1].
    """
    seen = likelihoods(surface, films, rest_time)
    ever = seen.known.any((0, 1))
    if not ever.any():
        return np.zeros(len(surface), dtype=bool)
    odds, links = _log_odds(seen) + PRIOR, _links(surface)
    moves = _cut(surface, links, np.where(ever, np.clip(odds, -MOST, MOST), 0.0))
    flat = _in_planes(surface, ever & ~moves)
    return _cut(surface, links, np.where(ever, np.clip(odds + IN_PLANE * flat, -MOST, MOST), -1.0 * flat))


def _log_odds(seen: Likelihoods) -> Float[np.ndarray, " n"]:
    """log p(pictures | it moves) - log p(pictures | it stands); 0 where nothing is known, as both likelihoods are 1."""
    there, other, busy = seen.there, seen.other, _busy(seen)[:, None]
    here, away = _mixed(AT_HOME, there, other).sum(0), other.sum(0)
    moves = [_mixed((share * busy).clip(1e-3, 0.98), here, away).sum(0) / ALIKE for share in GONE]
    hidden = [
        _mixed(share, there, other).sum(1) / ALIKE + np.log(often)
        for share, often in zip(HIDDEN, HOW_OFTEN_HIDDEN, strict=True)
    ]
    each = np.sum(logsumexp(hidden, axis=0), axis=0)
    covered = [
        _mixed(share * busy.clip(0.05), here, away).sum(0) / ALIKE + np.log(often)
        for share, often in zip(COVERED, HOW_OFTEN_COVERED, strict=True)
    ]
    stands = [each + np.log(1 - sum(HOW_OFTEN_COVERED)), *covered]
    return logsumexp(moves, axis=0) - np.log(len(GONE)) - logsumexp(stands, axis=0)


def _busy(seen: Likelihoods) -> Float[np.ndarray, " moments"]:
    """How busy each moment is: 1 where at least half as many points change as in the busiest one."""
    change = np.where(seen.known, expit(seen.other - seen.there), 0.0).sum(0) / np.maximum(
        seen.known.sum(0), 1
    )
    share = change[:, seen.known.any((0, 1))].mean(1)
    share = share - share.min()
    return (share / max(0.5 * share.max(), 1e-9)).clip(0, 1)


def _mixed(share: float | np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Logarithm of a mixture of two likelihoods, of which a share is the second."""
    return np.logaddexp(np.log1p(-share) + one, np.log(share) + other)


def _in_planes(surface: SurfacePoints, stands: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Points that lie in one of the few planes in which much of the surface stands."""
    rng, left, out = np.random.default_rng(0), stands.copy(), np.zeros_like(stands)
    for _ in range(MOST_PLANES):
        some = np.flatnonzero(left)
        best = np.zeros(0, int)
        for i in rng.choice(some, min(PLANES_TRIED, len(some)), replace=False):
            off = np.abs((surface.xyz[some] - surface.xyz[i]) @ surface.normals[i])
            level = surface.normals[some] @ surface.normals[i] > LEVEL
            best = max(best, some[(off < surface.spacing) & level], key=len)
        if len(best) < max(3, PLANE_SHARE * len(surface)):
            break
        middle = surface.xyz[best].mean(0)
        normal = np.linalg.svd(surface.xyz[best] - middle, full_matrices=False)[2][2]
        normal *= np.sign(normal @ surface.normals[best].mean(0))
        off = np.abs((surface.xyz - middle) @ normal)
        inside = (off < 1.5 * surface.spacing) & (surface.normals @ normal > LEVEL)
        out, left = out | inside, left & ~inside
    return out


def _links(surface: SurfacePoints) -> coo_matrix:
    """What it is worth that neighbours agree, in units of the cut."""
    xyz, n = surface.xyz, len(surface)
    distance, near = map(np.asarray, KDTree(xyz).query(xyz, k=NEIGHBOURS + 1))
    rows, columns = np.repeat(np.arange(n), NEIGHBOURS), near[:, 1:].ravel()
    level = (surface.normals[rows] * surface.normals[columns]).sum(1).clip(0, 1) ** 4
    alike = np.linalg.norm(surface.rgb[rows] - surface.rgb[columns], axis=1) / COLOUR_REACH
    weight = np.exp(-((distance[:, 1:].ravel() / (REACH * surface.spacing)) ** 2) - alike**2)
    # Along a ball the way between neighbours is level with the mean of their normals; up a step it is not.
    middle = surface.normals[rows] + surface.normals[columns]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-6)
    off = ((xyz[columns] - xyz[rows]) * middle).sum(1)
    weight *= TOGETHER * np.maximum(CREASE, level) * np.exp(-((off / (FLAT * surface.spacing)) ** 2))
    links = coo_matrix((np.round(UNIT * weight).astype(np.int32), (rows, columns)), shape=(n, n)).tocsr()
    return links.maximum(links.T).tocoo()


def _cut(surface: SurfacePoints, links: coo_matrix, votes: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which points move, by votes for motion (above 0) and against it, and by their neighbours."""
    n = len(surface)
    if not (votes > 0).any():
        return np.zeros(n, dtype=bool)
    source, sink = n, n + 1
    vote = np.round(UNIT * votes).astype(np.int32)
    for_it, against = np.flatnonzero(vote > 0), np.flatnonzero(vote < 0)
    graph = csr_matrix(
        (
            np.concatenate([links.data, vote[for_it], -vote[against]]).astype(np.int32),
            (
                np.concatenate([links.row, np.full(len(for_it), source), against]),
                np.concatenate([links.col, for_it, np.full(len(against), sink)]),
            ),
        ),
        shape=(n + 2, n + 2),
    )
    left = graph - maximum_flow(graph, source, sink).flow
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    moves = np.zeros(n + 2, dtype=bool)
    moves[breadth_first_order(left, source, return_predecessors=False)] = True
    return _without_crumbs(surface, moves[:n])


def _pieces(surface: SurfacePoints, some: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """The number of the piece of each of some points, within which they are neighbours."""
    pairs = KDTree(surface.xyz[some]).query_pairs(CRUMB_REACH * surface.spacing, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(some), len(some)))
    return connected_components(links, directed=False)[1]


def _without_crumbs(surface: SurfacePoints, moves: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    moves = moves.copy()
    whole = _sizes(surface, np.arange(len(moves)))
    for label in (True, False):
        some = np.flatnonzero(moves == label)
        size = _sizes(surface, some)
        moves[some[(size < CRUMB) & (size < whole[some])]] = not label
    return moves


def _sizes(surface: SurfacePoints, some: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """How many of some points are in the piece of each."""
    piece = _pieces(surface, some)
    return np.bincount(piece)[piece]
