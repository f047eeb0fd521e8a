"""Where a subject before a plain background can be: the visual hull of its silhouettes (Laurentini 1994).

Gives the tight box that the published method searches with a coarse model of its own (5000 iterations), and the
box that a moving subject sweeps. Silhouettes come from the pictures' alpha, else from their difference from the
plain colour; a point is kept unless a share of the cameras that see it sees background there.
"""

from collections.abc import Iterable

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import maximum_filter
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import read_pixels
from devrf.capture.scene import Background, PosedFrame, plain_colour, read_opacity
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.ndc import Ndc

MATTE = 0.02  # opacity, or difference from the plain colour, that counts as subject
MISSED = 0.1  # share of the cameras that may see background where the subject is (highlights, wrong mattes)


def silhouette(frame: PosedFrame, background: Background) -> Bool[np.ndarray, "h w"]:
    """Pixels of the full-size picture that show the subject."""
    opacity = read_opacity(frame, background)
    if opacity is not None:
        return opacity > MATTE * 255
    image = read_pixels(frame.path)
    plain = 255 * np.array(plain_colour(background) or (0.0, 0.0, 0.0), np.float32)
    return np.any(np.abs(image.astype(np.float32) - plain) > MATTE * 255, axis=-1)


def visual_hull(
    frames: Iterable[PosedFrame],
    aabb: Float[Tensor, "2 3"],
    shape: tuple[int, int, int],
    background: Background,
    least_seen: float = 0.0,
    ndc: Ndc | None = None,
) -> Bool[Tensor, "X Y Z"]:
    """Vertices of a grid over the box at which the subject can be, by the silhouettes of pictures of one moment.

    With `ndc` the grid's positions are normalised device coordinates.
    """
    points = vertices(aabb, shape).reshape(-1, 3)
    sides = (aabb[1] - aabb[0]) / (torch.tensor(shape) - 1)
    voxel = float(sides.max()) if ndc is None else float(sides[0]) * ndc.tan_x  # the latter at a depth of 1
    flat = (points if ndc is None else ndc.to_world(points)).numpy().astype(np.float64)
    seen, missed = np.zeros(len(flat), np.int32), np.zeros(len(flat), np.int32)
    count = 0
    for frame in frames:
        count += 1
        mask, camera = silhouette(frame, background), frame.camera
        inside, hit = _looked_up(mask, camera, flat, voxel, ndc is not None)
        seen += inside
        missed += inside & ~hit
    keep = (seen >= max(1, least_seen * count)) & (missed <= MISSED * seen)
    return torch.from_numpy(keep.reshape(shape))


def box_of(
    kept: Bool[Tensor, "X Y Z"], aabb: Float[Tensor, "2 3"], margin: float
) -> Float[Tensor, "2 3"] | None:
    """Box around kept vertices, enlarged about its centre, within `aabb`; None if nothing is kept."""
    if not bool(kept.any()):
        return None
    points = vertices(aabb, (kept.shape[0], kept.shape[1], kept.shape[2]))[kept]
    voxel = (aabb[1] - aabb[0]) / (torch.tensor(kept.shape) - 1)
    lo, hi = points.amin(0) - voxel / 2, points.amax(0) + voxel / 2
    centre, half = (lo + hi) / 2, (hi - lo) / 2 * margin
    return torch.stack([torch.maximum(centre - half, aabb[0]), torch.minimum(centre + half, aabb[1])])


def _looked_up(
    mask: np.ndarray, camera: Camera, points: np.ndarray, voxel: float, per_depth: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Whether each point lies in the picture, and whether the silhouette reaches within half a voxel of it.

    With `per_depth` voxels grow with the depth, and `voxel` is their size at a depth of 1.
    """
    depth = points @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
    pixels = np.nan_to_num(camera.project(points), nan=-1.0, posinf=-1.0, neginf=-1.0)
    u, v = np.clip(np.floor(pixels), -1, 1 << 20).astype(np.int64).T
    inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    if not inside.any():
        return inside, inside
    distance = 1.0 if per_depth else np.median(depth[inside])
    radius = int(np.ceil(camera.K[0, 0] * voxel * 0.87 / distance))
    grown = maximum_filter(mask, size=2 * radius + 1, mode="constant")
    hit = np.zeros(len(points), bool)
    hit[inside] = grown[v[inside], u[inside]]
    return inside, hit
