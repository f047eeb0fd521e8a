"""What masks of the subject say of a box and of sparse points, and what cameras see of the box."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from devrf.calibration.extent.mask_box import NOTHING, unexplained
from devrf.calibration.extent.motion_masks import MotionMask
from devrf.capture.camera import Camera
from devrf.capture.scene import SparsePoints

CELLS = 24  # along each side of the box, for what cameras see of it
LEAST_SWEPT = 3  # pictures of the sweep: a surface is told from two, if they are the right ones
# times what fixed cameras show: what moves is then made of what is too coarse for their pictures
FAR_PIXELS = 3.0


@dataclass(frozen=True)
class CutOff:
    """Something that moves beyond the box, or that nothing in the box explains.

    Attributes:
        share: Of all that moves in the camera's picture.
        place: Middle of its largest piece, from the left and from the top, in the picture's sides.
    """

    share: float
    place: tuple[float, float]


def outside_box(
    masks: Bool[np.ndarray, "n h w"],
    camera: Camera,
    box_from_world: Float[np.ndarray, "4 4"],
    aabb: Float[np.ndarray, "2 3"],
) -> Float[np.ndarray, " n"]:
    """Share of each mask's pixels whose rays miss the box; 0 for empty masks.

    Args:
        masks: Of one camera, at its size.
        camera: In the world.
        box_from_world, aabb: The box.
    """
    misses = _misses(camera, box_from_world, aabb)
    return (masks & misses).sum((1, 2)) / np.maximum(masks.sum((1, 2)), 1)


def cut_off(
    mask: MotionMask, box_from_world: Float[np.ndarray, "4 4"], aabb: Float[np.ndarray, "2 3"]
) -> CutOff | None:
    """The largest thing that moves beyond the box in a camera's picture; shadows and light are none."""
    beyond = mask.moved & _misses(mask.camera, box_from_world, aabb)
    piece = _largest_piece(beyond)
    return _found(piece, piece, mask.moved) if piece.any() else None


def not_explained(
    masks: Sequence[MotionMask],
    box_from_world: Float[np.ndarray, "4 4"],
    aabb: Float[np.ndarray, "2 3"],
    before: Float[np.ndarray, "p 3"] = NOTHING,
) -> list[CutOff | None]:
    """Of all that changes before each camera what looks at nothing in the box that others show changing, too.

    `before`: as `unexplained`'s.
    """
    every = [MotionMask(mask.camera, mask.mask) for mask in masks]
    left = unexplained(every, box_from_world, aabb, before)
    return [
        _found(pixels, _largest_piece(pixels), mask.mask) if pixels.any() else None
        for mask, pixels in zip(masks, left, strict=True)
    ]


def seen_by_fewer(
    cameras: Sequence[Camera],
    box_from_world: Float[np.ndarray, "4 4"],
    aabb: Float[np.ndarray, "2 3"],
    least: int,
) -> float:
    """Share of the box that lies in the pictures of fewer than `least` cameras."""
    points = _cells(aabb)
    seen = np.sum([_shows(c.moved(box_from_world), points) for c in cameras], axis=0)
    return float((seen < least).mean())


def not_swept(
    sweep: Sequence[Camera],
    fixed: Sequence[Camera],
    box_from_world: Float[np.ndarray, "4 4"],
    aabb: Float[np.ndarray, "2 3"],
) -> float:
    """Share of the box that too few pictures of the sweep show, or only from far away.

    Far away is where a pixel of the sweep covers several times what a pixel of the fixed cameras does, in the middle of
    the box.
    """
    finest = np.median([np.linalg.norm(c.moved(box_from_world).centre) / c.K[0, 0] for c in fixed])
    points = _cells(aabb)
    seen = np.zeros(len(points), int)
    for camera in [c.moved(box_from_world) for c in sweep]:
        covers = np.linalg.norm(points - camera.centre, axis=1) / camera.K[0, 0]
        seen += _shows(camera, points) & (covers < FAR_PIXELS * finest)
    return float((seen < LEAST_SWEPT).mean())


def points_of_subject(
    points: SparsePoints, cameras: Sequence[Camera], masks: Sequence[Bool[np.ndarray, "_ _"]]
) -> SparsePoints:
    """The sparse points that most of the sweep's pictures that see them show on the subject.

    Args:
        points: Of the scene at rest.
        cameras: Of the sweep's pictures, at the size of their masks.
        masks: Where each picture shows the subject.
    """
    inside = np.zeros(len(points.obs_point), bool)
    for n, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        here = points.obs_frame == n
        u, v = (
            np.floor(np.nan_to_num(camera.project(points.xyz[points.obs_point[here]]), nan=-1)).astype(int).T
        )
        within = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        shown = np.zeros(len(u), bool)
        shown[within] = mask[v[within], u[within]]
        inside[here] = shown
    sightings = np.bincount(points.obs_point, minlength=len(points.xyz))
    keep = 2 * np.bincount(points.obs_point, inside, len(points.xyz)) > sightings
    number, seen = np.cumsum(keep) - 1, keep[points.obs_point]
    return SparsePoints(points.xyz[keep], number[points.obs_point[seen]], points.obs_frame[seen])


def _largest_piece(pixels: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    pieces = np.empty(pixels.shape, dtype=np.int32)
    ndimage.label(pixels, structure=np.ones((3, 3)), output=pieces)
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    return (pieces == sizes.argmax()) & pixels


def _found(
    pixels: Bool[np.ndarray, "h w"], piece: Bool[np.ndarray, "h w"], of: Bool[np.ndarray, "h w"]
) -> CutOff:
    """Pixels' share of others, and the middle of a piece of them."""
    v, u = np.nonzero(piece)
    height, width = pixels.shape
    share = float(pixels.sum() / np.maximum(of.sum(), 1))
    return CutOff(share, (float(u.mean() + 0.5) / width, float(v.mean() + 0.5) / height))


def _misses(
    camera: Camera, box_from_world: Float[np.ndarray, "4 4"], aabb: Float[np.ndarray, "2 3"]
) -> Bool[np.ndarray, "h w"]:
    """Where rays of a camera in the world miss the box."""
    moved = camera.moved(box_from_world)
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays_d = moved.directions(np.stack([u, v], axis=-1))
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (aabb[0] - moved.centre) / rays_d, (aabb[1] - moved.centre) / rays_d
    enter, leave = np.fmin(a, b).max(-1), np.fmax(a, b).min(-1)
    return ~(leave > np.maximum(enter, 0.0))


def _cells(aabb: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "n 3"]:
    """Middles of the box's cells."""
    axes = [np.linspace(lo, hi, CELLS + 1)[:-1] + (hi - lo) / (2 * CELLS) for lo, hi in aabb.T]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _shows(camera: Camera, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Which points lie in a camera's picture."""
    pixel = np.nan_to_num(camera.project(points), nan=-1.0)
    inside = (pixel >= 0) & (pixel < [camera.width, camera.height])
    return inside[:, 0] & inside[:, 1]
