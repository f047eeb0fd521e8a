"""The colour of one surface point in two pictures.

Around each point a small square patch is laid in the world, facing half way between both cameras, and sampled through
both cameras. So scale, turn and lens distortion are the pictures' own. A point counts where both patches show the same
texture: then it is the same surface, seen unhidden in both. Its colour is the mean of the patch in linear light.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from devrf.capture.camera import Camera
from devrf.capture.colour.srgb import LINEAR_OF_LEVEL

# samples of a patch, a pixel apart in the coarser picture: enough texture, and small against the scene
SIDE = 9
LIKE = 0.8  # normalised correlation: accidental likeness of 81 samples with this much texture stays below 0.6
PLAIN = 0.02  # standard deviation of log light below which a patch's texture is noise
FLOOR = 0.01  # linear light; below it 8 bits are steps of 10 % and more
WHITE_LEVEL = 250  # of 255: a channel from here on may be clipped (compression rings around 255)
DARK = 0.004  # mean linear light of a patch: 13 of 255, below it cameras' black levels decide


@dataclass(frozen=True)
class View:
    """A picture with its camera."""

    camera: Camera
    rgb: UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True)
class Pairs:
    """Colours of points that two cameras see, linear light.

    Attributes:
        first, second: Names of the cameras.
        colours: In the first and in the second camera [n, 2, 3].
        place: Where the second camera sees them, as shares of its picture's width [n, 2].
        alike: Points that say as much as one alone: neighbours share their shading and their errors.
    """

    first: str
    second: str
    colours: Float[np.ndarray, "n 2 3"]
    place: Float[np.ndarray, "n 2"]
    alike: int = 10


def shared_colours(
    points: Float[np.ndarray, "n 3"],
    first: View,
    second: View,
    seen: tuple[Float[np.ndarray, "n 2"] | None, Float[np.ndarray, "n 2"] | None] = (None, None),
) -> tuple[Float[np.ndarray, "n 2 3"], Bool[np.ndarray, " n"]]:
    """Colours of points in two pictures.

    Args:
        points: Positions in the world.
        first, second: The pictures.
        seen: Where features of the points were found in each, pixels; None: they are where the cameras project them.
    Returns:
        Linear light in both, and which of the points both show unhidden and unclipped.
    """
    if not len(points):
        return np.zeros((0, 2, 3)), np.zeros(0, dtype=bool)
    patches = _patches(points, first.camera, second.camera)
    views = ((first, seen[0]), (second, seen[1]))
    (a, a_usable), (b, b_usable) = (_sampled(view, patches, at) for view, at in views)
    usable = a_usable & b_usable & (_likeness(a, b) > LIKE)
    colours = np.stack([a.mean(axis=1), b.mean(axis=1)], axis=1)
    return colours, usable & (colours.mean(axis=2).min(axis=1) > DARK)


def _patches(points: Float[np.ndarray, "n 3"], a: Camera, b: Camera) -> Float[np.ndarray, "n s 3"]:
    """World positions of each point's patch, row by row."""
    to_a, to_b = a.centre - points, b.centre - points
    far_a, far_b = (np.linalg.norm(v, axis=1, keepdims=True) for v in (to_a, to_b))
    normal = to_a / far_a + to_b / far_b
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    right = np.cross(-a.cam_from_world[1, :3], normal)  # the picture's up is not along a normal that faces it
    right /= np.maximum(np.linalg.norm(right, axis=1, keepdims=True), 1e-9)
    step = np.maximum(far_a / a.K[0, 0], far_b / b.K[0, 0])[:, :, None]
    offsets = np.arange(SIDE) - (SIDE - 1) / 2
    x, y = (v.reshape(1, -1, 1) for v in np.meshgrid(offsets, offsets))
    return points[:, None] + step * (x * right[:, None] + y * np.cross(normal, right)[:, None])


def _sampled(
    view: View, patches: Float[np.ndarray, "n s 3"], seen: Float[np.ndarray, "n 2"] | None
) -> tuple[Float[np.ndarray, "n s 3"], Bool[np.ndarray, " n"]]:
    """Linear light of the patches in a picture, and which lie in it and are not clipped."""
    at = view.camera.project(patches)
    if seen is not None:
        at += (seen - at[:, patches.shape[1] // 2])[:, None]
    x, y = np.moveaxis(at.astype(np.float32) - np.float32(0.5), -1, 0)  # OpenCV's first pixel is at 0
    # false for NaN
    inside = (x >= 0) & (x <= view.camera.width - 1) & (y >= 0) & (y <= view.camera.height - 1)
    x, y = np.where(inside, x, -1), np.where(inside, y, -1)
    light = cv2.remap(LINEAR_OF_LEVEL[view.rgb], x, y, cv2.INTER_LINEAR)
    levels = cv2.remap(view.rgb, x, y, cv2.INTER_NEAREST)
    return light, inside.all(axis=1) & (levels < WHITE_LEVEL).all(axis=(1, 2))


def _likeness(a: Float[np.ndarray, "n s 3"], b: Float[np.ndarray, "n s 3"]) -> Float[np.ndarray, " n"]:
    """Normalised correlation of the patches' log light; 0 where one of them is plain."""
    logs = [np.log(v.mean(axis=2) + FLOOR) for v in (a, b)]
    p, q = (v - v.mean(axis=1, keepdims=True) for v in logs)
    spread = p.std(axis=1) * q.std(axis=1)
    plain = np.minimum(p.std(axis=1), q.std(axis=1)) < PLAIN
    return np.where(plain, 0.0, (p * q).mean(axis=1) / np.maximum(spread, 1e-12))
