"""Which surface points move: by what cameras that saw them at rest see there later, and by their neighbours.

A point moves if every camera that saw it sees something else there for much of the time in which things move: what
covers it hides it from some cameras only, so what one camera alone saw says little. A shadow changes the brightness of
neighbours alike, and not colour; before a plain wall of its own hue so does a thing that leaves, but other cameras see
other colours behind it. Labels are a minimum cut (Boykov and Kolmogorov, PAMI 2004) on the surface, in which
neighbours of one plane and colour belong together.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import KDTree

from devrf.reconstruct.pictures import spread
from devrf.reconstruct.still_picture import MOST_PICTURES
from devrf.reconstruct.tracking.film import Film, blurred, sampled
from devrf.reconstruct.tracking.sight import Sight
from devrf.reconstruct.tracking.surface import Surface

LOWEST = 5  # pictures by which a point's own noise is known; of fewer than 25, one in five
CHANGED, CHANGED_RAW = 0.045, 0.06  # of the full range; brightness made equal, and as it is
BLUR_PX, LIGHT_PX = 1.0, 2.0  # of colours; of brightness
DARKER, BRIGHTER = 0.45, 1.6  # than at rest, in shadow and in light
LIT_ALIKE = 32  # neighbours whose median tells the light: of 16, a square of a chequered capsule is most
BUSY = 0.5  # of the largest share of points that change: in pictures with as many, something moves
MOVES = 0.3  # share of the busy pictures from which a point moves
ONE_CAMERA = 0.6  # weight of what one camera says alone
STAYS = 0.6  # weight of the vote against motion
SHADE = 0.1  # the same where only brightness changes: else the edge of a shade takes all that it crosses for moving
# Weight of the vote of what changes in brightness for some cameras, and in colour for others: by 1.0 39 other points
# beside what moves move in `yard`, by 0.5 11; by 0.3 half of a plain arm is not found.
PLAIN = 0.5
NEIGHBOURS, REACH, COLOUR_REACH = 12, 2.25, 0.3  # number; spacings; of the full range
# Votes that neighbours of one plane and colour are worth: what moves by either. By the first alone, things stay
# where they stand on others, as bricks do; by the second alone, poles do beside a sheet, and its edge with them. White
# shoes on a brown floor are only found by 2.0 or less; by 1.0 floor at a door moves.
TOGETHER = 8.0, 2.0
# Share of the busy pictures in which a piece that only the second finds looks other than at rest, by its median point.
# What has gone stays away: bricks, shoes and a box on a rug have 0.78 to 1.0, a capsule that turns there 0.71; floor at
# a door that turns has 0.56.
AWAY = 0.65
# It stands, too, if more than this share of it lies in the surface of what stands: floor that is covered, or in the
# shade, for most of the time has 0.44 to 0.62; shoes and edges of blocks on it have 0.15 to 0.28 (five captures).
IN_SURFACE, LEVEL = 0.35, 0.8  # the latter: cosine between normals
CREASE, FLAT = 0.003, 0.5  # of that, across a crease; spacings off each other's plane
# Fewer points than these, nearer than so many spacings, follow their surroundings, if they have any.
CRUMB, CRUMB_REACH = 60, 2.5
BY_TWO = 0.1  # share of a piece's seen points: fog has 0 to 0.03, what moves 0.22 and more (five captures)
UNIT = 1000  # of weights, which are whole numbers in the cut


def moving_points(surface: Surface, films: Sequence[Film], rest_time: float) -> Bool[np.ndarray, " n"]:
    """Whether each point moves.

    Args:
        surface: At rest.
        films: Of the fixed cameras; what stands in them is not looked at.
        rest_time: Of the scene, in [0, 1].
    """
    even, raw = np.stack([_changes(surface, film, rest_time) for film in films], axis=1)
    votes, cameras = _votes(even, raw), np.isfinite(even).sum(0)
    firm, loose = (_seen_by_two(surface, _cut(surface, votes, t), cameras) for t in TOGETHER)
    return firm | _rises(surface, _away(surface, loose & ~firm, even), ~(firm | loose))


def _changes(surface: Surface, film: Film, rest_time: float) -> Float[np.ndarray, "2 n"]:
    """Share of the busy pictures in which each point looks other than at rest, brightness made equal and as it is.

    Brightness is made equal point by point, which leaves colours to compare; and by the median of neighbours, which
    leaves patterns that are but brighter and darker. NaN where the camera did not see it at rest.
    """
    out = np.full((2, len(surface)), np.nan)
    at_rest = film.nearest(rest_time, float(np.diff(film.times).max()))
    if at_rest is None:
        return out
    sight = Sight(film, surface.xyz, surface.normals, surface.spacing)
    seen = np.flatnonzero(sight.seen)
    if not len(seen):
        return out
    at, before = sight.at[seen], film.picture(at_rest)
    colour, light = sampled(blurred(before, BLUR_PX), at), sampled(blurred(before.mean(-1), LIGHT_PX), at)
    near = KDTree(surface.xyz[seen]).query(surface.xyz[seen], k=min(LIT_ALIKE, len(seen)))[1]
    around = np.asarray(near).reshape(len(seen), -1)
    apart: list[list[np.ndarray]] = [[], []]
    for n in spread(range(len(film.times)), MOST_PICTURES):
        picture = film.picture(n)
        now = sampled(blurred(picture, BLUR_PX), at)
        gain = sampled(blurred(picture.mean(-1), LIGHT_PX), at) / np.maximum(light, 0.02)
        gain = gain.clip(DARKER, BRIGHTER)
        shared = np.median(gain[around], axis=1)
        hue = np.abs(now / gain[:, None] - colour).max(1) * np.minimum(1, gain)
        pattern = np.abs(now.mean(1) / shared - colour.mean(1)) * np.minimum(1, shared)
        apart[0].append(np.maximum(hue, pattern))
        apart[1].append(np.abs(now - colour).max(1))
    for row, changes, least in zip(out, apart, (CHANGED, CHANGED_RAW), strict=True):
        stack = np.stack(changes)
        lowest = max(1, min(LOWEST, len(stack) // LOWEST))
        usual = np.sort(stack, axis=0)[:lowest].mean(0)
        changed = stack > usual + least
        amount = changed.mean(1)
        row[seen] = changed[amount >= BUSY * amount.max()].mean(0)
    return out


def _votes(even: Float[np.ndarray, "c n"], raw: Float[np.ndarray, "c n"]) -> Float[np.ndarray, " n"]:
    """For motion above 0, against it below; 0 where nothing is known.

    What changes in brightness only may be shade: a little against motion, if no camera sees another colour there. A
    white arm before a white wall changes like that, and before all else in colour, too: of its points that two cameras
    saw 34 %, of those that stand, in seven captures, at most 0.6 %. (So do 847 of yard's 22,828 points, where a door
    shades the floor that it hides; neighbours hold all of them but 11.)
    """
    seen = np.isfinite(even).sum(0)
    least, least_raw = (np.where(np.isfinite(x), x, 9.0).min(0) for x in (even, raw))
    most = np.where(np.isfinite(even), even, 0.0).max(0)
    brightness = (least <= MOVES) & (least_raw > MOVES + 0.1)
    plain = brightness & (most > MOVES)
    share = np.where(plain, np.minimum(least_raw, most), least)
    votes = np.where(share > MOVES, np.clip(3 * share - 0.6, 0, 1), -STAYS * np.clip(1.2 - 3 * share, 0, 1))
    votes[plain] *= PLAIN
    votes[brightness & ~plain] = -SHADE
    return votes * np.select([seen == 0, seen == 1], [0.0, ONE_CAMERA], 1.0)


def _cut(surface: Surface, votes: Float[np.ndarray, " n"], together: float) -> Bool[np.ndarray, " n"]:
    xyz, n = surface.xyz, len(surface)
    if n <= NEIGHBOURS or not (votes > 0).any():
        return np.zeros(n, dtype=bool)
    distance, near = map(np.asarray, KDTree(xyz).query(xyz, k=NEIGHBOURS + 1))
    rows, columns = np.repeat(np.arange(n), NEIGHBOURS), near[:, 1:].ravel()
    level = (surface.normals[rows] * surface.normals[columns]).sum(1).clip(0, 1) ** 4
    alike = np.linalg.norm(surface.rgb[rows] - surface.rgb[columns], axis=1) / COLOUR_REACH
    weight = np.exp(-((distance[:, 1:].ravel() / (REACH * surface.spacing)) ** 2) - alike**2)
    # Along a ball the way between neighbours is level with the mean of their normals; up a step it is not.
    middle = surface.normals[rows] + surface.normals[columns]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-6)
    off = ((xyz[columns] - xyz[rows]) * middle).sum(1)
    weight *= together * np.maximum(CREASE, level) * np.exp(-((off / (FLAT * surface.spacing)) ** 2))
    links = coo_matrix((np.round(UNIT * weight).astype(np.int32), (rows, columns)), shape=(n, n)).tocsr()
    links = links.maximum(links.T).tocoo()
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


def _seen_by_two(
    surface: Surface, moves: Bool[np.ndarray, " n"], cameras: Int[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Without pieces that hardly anything but one camera saw, where others were seen by more.

    Such a piece may as well be covered by what moves, and mostly is fog before a plain wall.
    """
    kept = _pieces_with(surface, moves, cameras >= 2, cameras >= 1, BY_TWO)
    return kept if kept.any() else moves


def _away(
    surface: Surface, moves: Bool[np.ndarray, " n"], even: Float[np.ndarray, "c n"]
) -> Bool[np.ndarray, " n"]:
    """Only pieces that are seen to be away for most of the time: the edge of a shade comes and goes."""
    least = np.where(np.isfinite(even), even, np.inf).min(axis=0)
    seen = np.isfinite(least)
    return _pieces_with(surface, moves, seen & (least > AWAY), seen, 0.5)


def _rises(
    surface: Surface, moves: Bool[np.ndarray, " n"], stands: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Only pieces, and no crumbs, that rise from what stands: what lies in its surface is a part of it.

    Such a place was covered, or in the shade.
    """
    if not stands.any():
        return moves
    moves = _without_crumbs(surface, moves)
    some = np.flatnonzero(moves)
    nearest = np.flatnonzero(stands)[KDTree(surface.xyz[stands]).query(surface.xyz[some])[1]]
    normals, rises = surface.normals[nearest], np.zeros_like(moves)
    off = np.abs(((surface.xyz[some] - surface.xyz[nearest]) * normals).sum(1))
    rises[some] = (off > surface.spacing) | ((surface.normals[some] * normals).sum(1) <= LEVEL)
    return _pieces_with(surface, moves, rises, moves, 1 - IN_SURFACE)


def _pieces_with(
    surface: Surface,
    moves: Bool[np.ndarray, " n"],
    good: Bool[np.ndarray, " n"],
    known: Bool[np.ndarray, " n"],
    share: float,
) -> Bool[np.ndarray, " n"]:
    """Those pieces of what moves of whose known points more than a share are good."""
    some, out = np.flatnonzero(moves), np.zeros_like(moves)
    if len(some):
        piece = _pieces(surface, some)
        out[some] = (np.bincount(piece, good[some]) > share * np.bincount(piece, known[some]))[piece]
    return out


def _pieces(surface: Surface, some: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """The number of the piece of each of some points, within which they are neighbours."""
    pairs = KDTree(surface.xyz[some]).query_pairs(CRUMB_REACH * surface.spacing, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(some), len(some)))
    return connected_components(links, directed=False)[1]


def _without_crumbs(surface: Surface, moves: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    moves = moves.copy()
    whole = _sizes(surface, np.arange(len(moves)))
    for label in (True, False):
        some = np.flatnonzero(moves == label)
        size = _sizes(surface, some)
        moves[some[(size < CRUMB) & (size < whole[some])]] = not label
    return moves


def _sizes(surface: Surface, some: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """How many of some points are in the piece of each."""
    piece = _pieces(surface, some)
    return np.bincount(piece)[piece]
