"""Bursts: pictures of a scene at rest that show nearly the same, because they were taken from one place in one moment.

A picture that is held out to measure with would be flattered by its near-double in training, so that a burst is held
out whole or not at all.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from devrf.capture.camera import Camera

# From one place: nearer than this share of the cameras' usual distance from their middle, and turned by less.
# Neighbours of a dense sweep, 300 pictures around a scene, stand 0.02 and 1.2 degrees apart.
SAME_PLACE, SAME_DEG = 0.01, 1.0
# In one moment: within so long, where most pictures are further apart in time, ...
SAME_S = 1.0
NEAR_PLACE, NEAR_DEG = 0.1, 10.0  # ... and so near: two people may film at once


def bursts(cameras: Sequence[Camera], taken_s: Sequence[float | None] = ()) -> list[list[int]]:
    """Numbers of the pictures of each burst, in order; those that stand alone are not named.

    Args:
        cameras: Of the pictures.
        taken_s: When each was taken, seconds; None where that is not known; empty: of none.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    count = len(cameras)
    if count < 2:
        return []
    poses = np.array([camera.cam_from_world[:3, :3] for camera in cameras])
    centres = np.array([camera.centre for camera in cameras])
    usual = float(np.median(np.linalg.norm(centres - centres.mean(axis=0), axis=1)))
    one, other = KDTree(centres).query_pairs(NEAR_PLACE * usual, output_type="ndarray").T
    apart = np.linalg.norm(centres[one] - centres[other], axis=1) / max(usual, 1e-9)
    cosine = ((poses[one] * poses[other]).sum(axis=(1, 2)) - 1) / 2
    turned_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    pairs = np.column_stack([one, other])
    linked = _to_first(pairs[(apart < SAME_PLACE) & (turned_deg < SAME_DEG)], count)
    if taken_s:
        time_s = np.array([np.nan if t is None else t for t in taken_s])
        if _usual_step(time_s) > SAME_S:
            moment = np.abs(time_s[one] - time_s[other]) <= SAME_S
            linked += map(tuple, pairs[moment & (turned_deg < NEAR_DEG)].tolist())
    links = np.array(linked, dtype=np.int64).reshape(-1, 2).T
    graph = csr_array((np.ones(links.shape[1]), (links[0], links[1])), shape=(count, count))
    group = connected_components(graph, directed=False)[1]
    found = [np.flatnonzero(group == g).tolist() for g in dict.fromkeys(group.tolist())]
    return [members for members in found if len(members) > 1]


def held_out(count: int, every: int, found: Sequence[Sequence[int]] = ()) -> Bool[np.ndarray, " n"]:
    """Which of so many pictures are held out: every n-th, a burst counting as one."""
    first = {member: members[0] for members in found for member in members}
    leads = np.array([first.get(n, n) for n in range(count)], dtype=np.int64)
    return np.unique(leads, return_inverse=True)[1] % every == 0


def _to_first(same: Int[np.ndarray, "pairs 2"], count: int) -> list[tuple[int, int]]:
    """Of pairs from one place, links to the first picture of each place: a slow walk is no chain of them."""
    near: list[list[int]] = [[] for _ in range(count)]
    for one, other in same.tolist():
        near[min(one, other)].append(max(one, other))
    led, linked = [False] * count, list[tuple[int, int]]()
    for n in range(count):
        if led[n]:
            continue
        members = [k for k in near[n] if not led[k]]
        linked += [(n, k) for k in members]
        for k in members:
            led[k] = True
    return linked


def _usual_step(time_s: Float[np.ndarray, " n"]) -> float:
    """Between pictures whose times are known; 0 with fewer than two."""
    steps = np.diff(np.sort(time_s[np.isfinite(time_s)]))
    return float(np.median(steps)) if len(steps) else 0.0
