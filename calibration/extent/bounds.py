"""Where the subject is: the box that the model fills, near and far, inward- or forward-facing.

The box stands upright (its z axis is the mean up direction of the sweep) and is centred at the origin of the
box frame with a longest half side of 1. Where cameras film motion, it must hold everything that moves: pixels
that change over time say where that is (`mask_box`). Where nothing moves, it holds the points around the
focus, the point closest to all view axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from devrf.calibration.extent.mask_box import NOTHING, MaskHull
from devrf.calibration.extent.motion_masks import MotionMask
from devrf.capture.camera import Camera
from devrf.capture.scene import Kind
from devrf.capture.view_axes import closest_point

LEVEL_SPREAD = 0.3  # right axes that span a plane this clearly give the up direction
FORWARD_MEAN = 0.85  # length of the mean view direction: near 1 all cameras look the same way
SEARCH = 2.0  # times the median camera distance from the focus: nothing that moves is looked for farther away
POINT_SPARE = 0.05  # of the extent of the sweep's points: beyond the outermost few
STEPS = 21  # in which a box that is too large is drawn in
HULL_MARGIN = 1.15  # motion blur and thin parts are missed; the dilated masks allow for most of it
VOXEL = 1 / 20  # of the longest half side: a voxel of the coarsest grids, which every side has as margin
# points farther from the focus than this share of the median camera distance are surroundings
POINT_REACH = 0.9
POINT_PERCENTILES = (1.0, 99.0)
POINT_MARGIN = 1.1
MAX_ERROR_PX, MIN_TRACK = 2.0, 3
NEAR_SHARE, FAR_SHARE = 0.8, 1.2  # of the 1st and 99th percentile of the points' distances
SMALLEST_NEAR = 0.02  # of the longest half side


@dataclass(frozen=True)
class Bounds:
    """The box and what lies around it.

    Attributes:
        box_from_world: Similarity [4, 4].
        aabb: Corners in the box frame [2, 3].
        near, far: In box units, along rays.
        kind: `inward` or `forward`.
        size: Sides of the box, world units [3].
        basis: What the box was taken from, in words.
        before: Points that cameras were not asked behind, if any.
    """

    box_from_world: Float[np.ndarray, "4 4"]
    aabb: Float[np.ndarray, "2 3"]
    near: float
    far: float
    kind: Kind
    size: Float[np.ndarray, "3"]
    basis: str
    before: Float[np.ndarray, "p 3"] = field(default_factory=lambda: NOTHING)


@dataclass(frozen=True)
class Silhouettes:
    """What the fixed cameras show of the subject, for its visual hull.

    Attributes:
        masks: Their motion masks, or mattes.
        shown: What they show, in words.
        stretches: The same of shorter times, as `MaskHull` takes them.
        across: Widths of the masks' pictures that a mean side of the box may be long. A larger box is drawn in, at most
            to the smallest that explains what masks show; a smaller one is not: what is outside is modelled coarser.
    """

    masks: Sequence[MotionMask] = ()
    shown: str = "what moves"
    stretches: Sequence[Sequence[MotionMask | None]] = ()
    across: float = 0.0


def scene_bounds(
    sweep: Sequence[Camera],
    fixed: Sequence[Camera],
    points: Float[np.ndarray, "n 3"],
    distances: Float[np.ndarray, " m"],
    silhouettes: Silhouettes | None = None,
) -> Bounds:
    """Find the box.

    Args:
        sweep: The sweep's cameras; may be empty.
        fixed: The moving scene's cameras; may be empty.
        points: The sweep's good points [n, 3].
        distances: Distance of every sighting of a point from its camera [m].
        silhouettes: Of the subject, where there are some.
    Raises:
        ValueError: There is no camera at all.
    """
    cameras = [*sweep, *fixed]
    if not cameras:
        raise ValueError("bounds of a scene without cameras")
    box_from_up = upright(sweep or fixed, fixed or sweep)
    focus = focus_point(fixed if len(fixed) > 1 else cameras)
    region = _searched(points, focus, fixed or cameras, box_from_up)
    by = silhouettes or Silhouettes()
    hull, before = MaskHull.of(by.masks, region, box_from_up, by.stretches), NOTHING
    seen_by = [mask.camera for mask in by.masks]
    if hull is not None:
        (lo, hi), enough = _no_larger(hull, seen_by, box_from_up, by.across)
        # What stands before a thing hides it from some cameras: then others alone see it, and where their lines of
        # sight cross far away counts as well as where it is, unless cameras that cannot see it are not asked.
        hull = None if enough else MaskHull.of(by.masks, region, box_from_up, by.stretches, points)
        if hull is not None:
            other, _ = _no_larger(hull, seen_by, box_from_up, by.across)
            if np.prod(np.ptp(other, axis=0)) < np.prod(hi - lo):
                (lo, hi), before = other, points
        basis = f"visual hulls of {by.shown} in {len(by.masks)} cameras"
        margin = HULL_MARGIN
    else:
        lo, hi, basis = _point_box(points, focus_point(cameras), cameras, box_from_up)
        margin = POINT_MARGIN
    centre, half = (lo + hi) / 2, (hi - lo) / 2
    half = np.maximum(margin * half, half + VOXEL * half.max())
    unit = float(half.max())
    half = np.maximum(half, 0.1 * unit)
    box_from_world = np.eye(4)
    box_from_world[:3, :3] = box_from_up / unit
    box_from_world[:3, 3] = -centre / unit
    in_box = points @ box_from_world[:3, :3].T + box_from_world[:3, 3]
    near, far = _near_far(cameras, len(fixed), distances, in_box, box_from_world, half / unit)
    mean_view = float(np.linalg.norm(np.mean([c.cam_from_world[2, :3] for c in cameras], axis=0)))
    return Bounds(
        box_from_world=box_from_world,
        aabb=np.stack([-half / unit, half / unit]),
        near=near,
        far=far,
        kind="forward" if mean_view > FORWARD_MEAN else "inward",
        size=2 * half,
        basis=basis,
        before=before,
    )


def focus_point(cameras: Sequence[Camera]) -> Float[np.ndarray, "3"]:
    """The point closest to all view axes (instant-ngp's centre), robust to a few that look away."""
    centres = np.array([c.centre for c in cameras])
    axes = np.array([c.cam_from_world[2, :3] for c in cameras])
    focus = closest_point(centres, axes)
    for _ in range(5):
        offset = focus - centres
        miss = np.linalg.norm(offset - (offset * axes).sum(1, keepdims=True) * axes, axis=1)
        weight = 1 / np.maximum(miss, 0.1 * np.median(miss) + 1e-9)
        away = weight[:, None, None] * (np.eye(3) - axes[:, :, None] * axes[:, None, :])
        focus = np.linalg.lstsq(away.sum(0), (away @ centres[:, :, None]).sum(0)[:, 0], rcond=None)[0]
    depth = ((focus - centres) * axes).sum(1)
    if np.median(depth) <= 0:  # axes that spread apart meet behind the cameras
        focus = (
            centres + axes * float(np.linalg.norm(centres - centres.mean(0), axis=1).mean() + 1e-9)
        ).mean(0)
    return focus


def _searched(
    points: Float[np.ndarray, "n 3"],
    focus: Float[np.ndarray, "3"],
    cameras: Sequence[Camera],
    box_from_up: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "2 3"]:
    """Corners of where something may move: around the focus up to the cameras, and as far as the sweep's points go."""
    middle, distance = box_from_up @ focus, [float(np.linalg.norm(c.centre - focus)) for c in cameras]
    either = np.array([[-1.0], [1.0]])
    around, widest = (
        middle + reach * either for reach in (POINT_REACH * min(distance), SEARCH * np.median(distance))
    )
    if not len(points):
        return around
    ends = np.percentile(points @ box_from_up.T, POINT_PERCENTILES, axis=0)
    ends += POINT_SPARE * np.ptp(ends, axis=0) * either
    low, high = np.minimum(around[0], ends[0]), np.maximum(around[1], ends[1])
    return np.stack([np.maximum(widest[0], low), np.minimum(widest[1], high)])


def _no_larger(
    hull: MaskHull,
    cameras: Sequence[Camera],
    box_from_up: Float[np.ndarray, "3 3"],
    across: float,
) -> tuple[Float[np.ndarray, "2 3"], bool]:
    """A hull's box, drawn in towards its smallest until the mean side is so many widths long, margin included; and
    whether it is."""

    def small_enough(box: Float[np.ndarray, "2 3"]) -> bool:
        middle = box.mean(0) @ box_from_up
        width = np.median([np.linalg.norm(c.centre - middle) * c.width / c.K[0, 0] for c in cameras])
        return bool(HULL_MARGIN * np.prod(np.ptp(box, axis=0)) ** (1 / 3) <= across * width)

    if small_enough(hull.box):
        return hull.box, True
    smallest = hull.smallest_box()
    steps = (hull.box + share * (smallest - hull.box) for share in np.linspace(0, 1, STEPS))
    found = next((box for box in steps if small_enough(box)), None)
    return (smallest, False) if found is None else (found, True)


def upright(up_from: Sequence[Camera], front_from: Sequence[Camera]) -> Float[np.ndarray, "3 3"]:
    """Rotation whose z axis is the mean up of cameras and whose y axis is a mean view direction, levelled."""
    up = -np.mean([c.cam_from_world[1, :3] for c in up_from], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    rights = np.array([c.cam_from_world[0, :3] for c in up_from])
    _, spread, axes = np.linalg.svd(rights)
    if len(spread) == 3 and spread[1] > LEVEL_SPREAD * spread[0] and spread[2] < LEVEL_SPREAD * spread[1]:
        up = axes[2] * np.sign(axes[2] @ up)  # people hold cameras level: up is across all right axes
    front = np.mean([c.cam_from_world[2, :3] for c in front_from], axis=0)
    front = front - (front @ up) * up
    if np.linalg.norm(front) < 1e-3:
        front = np.cross(up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    front /= np.linalg.norm(front)
    return np.stack([np.cross(front, up), front, up])


def _point_box(
    points: Float[np.ndarray, "n 3"],
    focus: Float[np.ndarray, "3"],
    cameras: Sequence[Camera],
    box_from_up: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], str]:
    """Percentiles of the points around the focus; a cube where there are none."""
    distance = float(np.median([np.linalg.norm(c.centre - focus) for c in cameras]))
    near = points[np.linalg.norm(points - focus, axis=1) < POINT_REACH * distance]
    if len(near) < 30:
        half = 0.5 * max(distance, 1e-6)
        centre = box_from_up @ focus
        return centre - half, centre + half, "the focus of the view axes (no points near it)"
    lo, hi = np.percentile(near @ box_from_up.T, POINT_PERCENTILES, axis=0)
    return lo, hi, f"{len(near)} points around the focus of the view axes"


def _near_far(
    cameras: Sequence[Camera],
    fixed: int,
    distances: Float[np.ndarray, " m"],
    points: Float[np.ndarray, "n 3"],
    box_from_world: Float[np.ndarray, "4 4"],
    half: Float[np.ndarray, "3"],
) -> tuple[float, float]:
    """Nearest and farthest content along rays, box units; the box itself is never cut.

    What the sweep has come near to, a fixed camera sees from across the room: of these, the last `fixed` cameras, which
    have no sightings, all points count.
    """
    unit = np.cbrt(np.linalg.det(box_from_world[:3, :3]))
    centres = np.array([box_from_world[:3, :3] @ c.centre + box_from_world[:3, 3] for c in cameras])
    to_box = np.linalg.norm(np.maximum(np.abs(centres) - half, 0.0), axis=1)
    through_box = np.linalg.norm(np.abs(centres) + half, axis=1)
    near, far = float(to_box.min()), float(through_box.max())
    if len(distances):
        low, high = np.percentile(distances * unit, [1, 99])
        of_fixed = centres[len(cameras) - fixed :]
        away = [np.percentile(np.linalg.norm(points - centre, axis=1), 99) for centre in of_fixed]
        near, far = min(near, NEAR_SHARE * float(low)), max(far, FAR_SHARE * float(max([high, *away])))
    return max(near, SMALLEST_NEAR), far
