"""Rigid parts of what moves: the fewest rigid motions that explain the tracks.

Motions and labels are found in turn; labels are even on the surface. Then neighbours are merged while one motion
explains both. Distances between points that stay the same would be a weaker rule: on a figure they give fragments.
Where points are while they are lost is a guess, by which a thing that is covered for a while would fall to pieces.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix

MOST = 40  # parts to begin with
TURNS = 25  # of motions and labels, at most
EVEN = 2.0  # what agreeing with all neighbours is worth, in usual squared residuals
MOTION = 3.0  # how much more motion counts than place in the choice of the first parts
SAME = 0.75  # voxels: residual of two parts up to which they are one
# Of it: two parts are one in any case; else only while the residual grows by less than this.
SURELY, WORSE = 0.33, 1.4
SMALL, SMALL_SAME = 50, 3.3  # points; so much more residual joins a part of fewer
FEWEST = 8  # points that have a motion
GUESSED = 1e-4  # weight of a place that is a guess; of points that are never seen, guesses decide the part
MOMENTS = 16  # that are looked at, spread over all

Motions = tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"]]
"""Rotation and translation at each moment: a point x at rest is at R x + t."""


def motion_of(
    rest: Float[np.ndarray, "p 3"],
    tracks: Float[np.ndarray, "t p 3"],
    lost: Bool[np.ndarray, "t p"] | None = None,
) -> Motions:
    """The rigid motion that explains tracks best (Kabsch 1976); lost points count where few others are left."""
    weights = weights_of(tracks, lost)
    middle, middles = weights @ rest, np.einsum("tp,tpi->ti", weights, tracks)
    turned = (weights[..., None] * (rest - middle[:, None])).mT @ (tracks - middles[:, None])
    U, _, V = np.linalg.svd(turned)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    rotations = (U @ V).transpose(0, 2, 1)
    return rotations, middles - np.einsum("tij,tj->ti", rotations, middle)


def weights_of(
    tracks: Float[np.ndarray, "t p 3"], lost: Bool[np.ndarray, "t p"] | None = None
) -> Float[np.ndarray, "t p"]:
    """How much each point counts at each moment, 1 together; lost points do where few others are left."""
    counts = np.ones(tracks.shape[:2])
    if lost is not None:
        counts = np.where((~lost).sum(1, keepdims=True) >= FEWEST, ~lost, counts)
    return counts / counts.sum(1, keepdims=True)


def residual(
    motion: Motions,
    rest: Float[np.ndarray, "p 3"],
    tracks: Float[np.ndarray, "t p 3"],
    lost: Bool[np.ndarray, "t p"] | None = None,
) -> np.ndarray:
    """Mean squared distance of each point from where a rigid motion has it [p]; by what is seen of it, if anything."""
    rotations, shifts = motion
    apart = rest @ rotations.mT + (shifts[:, None] - tracks)
    weights = None if lost is None else np.where(lost, GUESSED, 1.0)
    return np.average(np.einsum("tpi,tpi->tp", apart, apart), axis=0, weights=weights)


def rigid_parts(
    rest: Float[np.ndarray, "p 3"],
    tracks: Float[np.ndarray, "t p 3"],
    lost: Bool[np.ndarray, "t p"],
    links: csr_matrix,
    voxel: float,
    seed: int = 0,
) -> Int[np.ndarray, " p"]:
    """The part of each point, counted from 0.

    Args:
        rest: Points at rest.
        tracks: Where they are.
        lost: When each point's place is a guess, which says hardly anything.
        links: Neighbours on the surface.
        voxel: Of the scene at rest, the unit of what counts as the same motion.
        seed: Of the choice of the first point.
    """
    looked_at = np.linspace(0, len(tracks) - 1, min(len(tracks), MOMENTS)).round().astype(int)
    tracks, lost = tracks[looked_at].astype(np.float64), lost[looked_at]
    labels = _first_parts(rest, tracks, lost, np.random.default_rng(seed))
    seen = ~lost.all(0) if not lost.all() else np.ones(len(rest), dtype=bool)
    beside = links.copy()
    beside.data = np.ones_like(beside.data)
    neighbours = np.maximum(np.asarray(beside.sum(1)).ravel(), 1)
    for _ in range(TURNS):
        kept = [k for k in np.unique(labels) if (labels == k).sum() >= FEWEST] or [labels[0]]
        mine = [labels == k for k in kept]
        motions = [motion_of(rest[m], tracks[:, m], lost[:, m]) for m in mine]
        cost = np.stack([residual(motion, rest, tracks, lost) for motion in motions])
        usual = max(float(np.median(cost.min(0)[seen])), 1e-7)
        agree = np.stack([np.asarray(beside @ m.astype(float)).ravel() / neighbours for m in mine])
        before, labels = labels, np.argmin(cost / usual - EVEN * agree, axis=0)
        if np.array_equal(before, labels):
            break
    return _merged(rest, tracks, lost, beside, labels, SAME * voxel)


def _first_parts(
    rest: Float[np.ndarray, "p 3"],
    tracks: Float[np.ndarray, "t p 3"],
    lost: Bool[np.ndarray, "t p"],
    rng: np.random.Generator,
) -> Int[np.ndarray, " p"]:
    """Around points that are far from one another, at rest and in motion, as far as both are seen."""
    seen = 1.0 - lost

    def away(n: int) -> np.ndarray:
        both = seen * seen[:, n, None]
        moved = (((tracks - tracks[:, n, None]) ** 2).mean(-1) * both).sum(0) / np.maximum(both.sum(0), 1)
        return MOTION * moved + ((rest - rest[n]) ** 2).sum(1)

    apart = [away(int(rng.integers(len(rest))))]
    for _ in range(min(MOST, len(rest)) - 1):
        apart.append(away(int(np.min(apart, axis=0).argmax())))
    return np.argmin(apart, axis=0)


def _merged(
    rest: np.ndarray,
    tracks: np.ndarray,
    lost: np.ndarray,
    beside: csr_matrix,
    labels: np.ndarray,
    same: float,
) -> Int[np.ndarray, " p"]:
    links = beside.tocoo()

    def spread(points: np.ndarray) -> float:
        """Root mean square distance of points from where one motion has them, over all that is seen of them."""
        mine = rest[points], tracks[:, points], lost[:, points]
        seen = np.where(mine[2], GUESSED, 1.0).sum(0)
        return float(np.sqrt(np.average(residual(motion_of(*mine), *mine), weights=seen)))

    own = {int(a): spread(labels == a) for a in np.unique(labels)}
    known: dict[tuple[int, int], float] = {}
    while True:
        best: tuple[float, int, int] | None = None
        for a, b in _touching(labels[links.row], labels[links.col]):
            if (a, b) not in known:
                together = spread((labels == a) | (labels == b))
                sizes = (labels == a).sum(), (labels == b).sum()
                apart = np.sqrt(np.average([own[a] ** 2, own[b] ** 2], weights=sizes))
                few = min(sizes) < SMALL
                limit = SMALL_SAME * same if few else min(same, max(WORSE * apart, SURELY * same))
                known[a, b] = together / limit
            if known[a, b] < 1 and (best is None or known[a, b] < best[0]):
                best = known[a, b], a, b
        if best is None:
            return np.unique(labels, return_inverse=True)[1]
        _, a, b = best
        labels = np.where(labels == b, a, labels)
        own[a] = spread(labels == a)
        known = {pair: value for pair, value in known.items() if not {a, b} & set(pair)}


def _touching(one: np.ndarray, other: np.ndarray) -> Iterator[tuple[int, int]]:
    pairs = np.unique(np.sort(np.stack([one, other], 1)[one != other], axis=1), axis=0)
    yield from ((int(a), int(b)) for a, b in pairs)
