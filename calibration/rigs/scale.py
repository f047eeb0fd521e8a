"""Metric scale of a sweep: true length over the sweep's length, from what has a known size.

A board that stands in the sweep: its corners are triangulated with the sweep's poses and compared with the
print. Two fixed cameras that saw a board at once: their distance in metres over their distance in the
sweep's model. Or a distance that somebody measured. Or, metres off, where photos say they were taken.
"""

from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.bundle.adjust import adjust
from devrf.calibration.bundle.problem import Problem, bodies_of_points, lenses
from devrf.calibration.intrinsics import Intrinsics
from devrf.calibration.rigs.rig import Scale
from devrf.calibration.truth import similarity
from devrf.capture.camera import Camera
from devrf.capture.view_axes import closest_point

MIN_VIEWS = 3  # sweep pictures that must see a corner
MIN_BOARD_CORNERS = 6
CORNER_STD_PX = 0.3  # of a board corner's place
MIN_ANGLE_DEG = 4.0  # between the outermost views of a corner
TAPE_STD = 0.01  # relative, of a length that somebody typed without saying how sure it is
LEAST_STD = 5e-4  # relative: no print is known better
AGREEMENT = 0.01  # relative: measures of length that differ by more have a mistake in them
RIGID_SHARE = 0.02  # of the board's size: corners that miss the print by more belong to a board that moved


def scale_from_board(
    views: list[BoardView], cameras: list[Camera], spec: BoardSpec
) -> tuple[Scale | None, str]:
    """Scale from a board that stands still in the sweep.

    Args:
        views: Of the board; `frame` indexes `cameras`.
        cameras: The sweep's cameras.
        spec: The settled board.
    Returns:
        The scale or None, and a sentence on what was seen.
    """
    ids, xyz, used = triangulate_corners(views, cameras)
    if len(ids) < MIN_BOARD_CORNERS:
        return (
            None,
            f"the board's corners are seen from {len(views)} sweep pictures, too few or too close together",
        )
    true = spec.corners[ids]
    true_from_sweep = similarity(xyz, true)
    factor = float(np.cbrt(np.linalg.det(true_from_sweep[:3, :3])))
    miss = np.linalg.norm(xyz @ true_from_sweep[:3, :3].T + true_from_sweep[:3, 3] - true, axis=1)
    spread = np.linalg.norm(true - true.mean(0), axis=1)
    rms = float(np.sqrt((miss**2).mean()))
    if rms > RIGID_SHARE * 2 * spread.max():
        return (
            None,
            f"the board's corners miss the print by {1e3 * rms:.1f} mm: it moved during the sweep or is bent",
        )
    std = rms / float(np.sqrt((spread**2).sum()))
    text = f"board in {used} sweep pictures, {len(ids)} corners, {1e3 * rms:.2f} mm from the print"
    return Scale(True, text, factor, std), text


def triangulate_corners(
    views: list[BoardView], cameras: list[Camera]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 3"], int]:
    """Corners in the sweep's frame from all views that see them: ids [n], positions [n, 3], pictures used."""
    sightings: dict[int, list[tuple[int, np.ndarray]]] = {}
    for view in views:
        for corner, xy in zip(view.ids.tolist(), view.xy, strict=True):
            sightings.setdefault(corner, []).append((view.frame, xy))
    ids, start, rows = [], [], []
    for corner, seen in sorted(sightings.items()):
        if len(seen) < MIN_VIEWS:
            continue
        centres = np.array([cameras[c].centre for c, _ in seen])
        rays = np.array([cameras[c].directions(xy[None])[0] for c, xy in seen])
        if np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))) < MIN_ANGLE_DEG:
            continue
        rows += [(c, len(ids), xy) for c, xy in seen]
        ids.append(corner)
        start.append(closest_point(centres, rays))
    if not ids:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), 0
    known = [Intrinsics(c.width, c.height, c.K, c.distortion, None, c.model) for c in cameras]
    solution = adjust(
        Problem(
            poses=np.array([c.cam_from_world for c in cameras]),
            free_pose=np.zeros(len(cameras), dtype=bool),
            device=np.arange(len(cameras)),
            **lenses(known, known),
            bodies=bodies_of_points(np.array(start)),
            freedom=np.full(len(ids), 3),
            obs_camera=np.array([c for c, _, _ in rows]),
            obs_body=np.array([p for _, p, _ in rows]),
            obs_local=np.zeros((len(rows), 3)),
            obs_xy=np.array([xy for _, _, xy in rows]),
            obs_std=np.full(len(rows), CORNER_STD_PX),
        )
    )
    return np.array(ids), solution.problem.points, len({c for c, _, _ in rows})


def scale_from_distances(
    metric: dict[str, Float[np.ndarray, "3"]], sweep: dict[str, Float[np.ndarray, "3"]], source: str
) -> Scale | None:
    """Scale from camera centres known in metres and in the sweep's unit; None with fewer than two cameras."""
    shared = [name for name in metric if name in sweep]
    pairs = list(combinations(shared, 2))
    if not pairs:
        return None
    true = np.array([np.linalg.norm(metric[a] - metric[b]) for a, b in pairs])
    ours = np.array([np.linalg.norm(sweep[a] - sweep[b]) for a, b in pairs])
    ratio = true / np.maximum(ours, 1e-12)
    factor = float(np.median(ratio))
    std = (
        float(1.4826 * np.median(np.abs(ratio / factor - 1)) / np.sqrt(len(pairs)))
        if len(pairs) > 1
        else None
    )
    return Scale(True, source, factor, std)


def combined(found: list[Scale]) -> Scale:
    """One scale of several measures of length: the weighted mean of those that agree with the surest.

    Args:
        found: At least one; a `std` that is not known counts as `TAPE_STD`.
    """
    std = np.array([max(TAPE_STD if s.std is None else s.std, LEAST_STD) for s in found])
    surest = found[int(np.argmin(std))]
    factors = np.array([s.factor for s in found])
    agree = np.abs(factors / surest.factor - 1) <= AGREEMENT
    if agree.sum() == 1:
        return surest
    weight = agree / std**2
    source = "; ".join(s.source for s, a in zip(found, agree, strict=True) if a)
    return Scale(True, source, float(weight @ factors / weight.sum()), float(weight.sum() ** -0.5))
