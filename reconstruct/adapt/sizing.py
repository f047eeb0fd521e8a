"""How much model a scene needs, found from its pictures; each decision comes with its reason."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.options import CanonicalOptions, MotionOptions, resized, resized_motion

FINEST_VOXEL = 1.0  # pixels, where the scene is: finer voxels hold nothing that the pictures show
FEWEST = 16  # voxels
NEARLY_ALL = 0.95  # of the resolution that was offered: motion levels stay as they are above


@dataclass(frozen=True)
class Decision:
    """What was chosen for the scene in place of what the preset offers, and why."""

    what: str
    chosen: str
    offered: str
    reason: str

    def __str__(self) -> str:
        """One line, as it is printed."""
        return f"{self.what}: {self.chosen} instead of {self.offered} ({self.reason})"


def needed_resolution(cameras: Sequence[Camera], aabb: Float[Tensor, "2 3"]) -> tuple[int, float]:
    """R at which a voxel is as large as what a pixel sees of the middle of the box, and that size, box units.

    Args:
        cameras: At training size, in the box frame.
        aabb: The box that is modelled.
    """
    lo, hi = aabb.double().numpy()
    middle, shortest = (lo + hi) / 2, float((hi - lo).min())
    seen = []
    for camera in cameras:
        away = float(np.linalg.norm(camera.world_from_cam[:3, 3] - middle))
        seen.append(max(away, shortest / 2) / _focal(camera))
    pixel = float(np.median(seen))
    side = float(np.prod(hi - lo)) ** (1 / 3)
    return max(FEWEST, math.ceil(side / (FINEST_VOXEL * pixel))), pixel


def needed_in_planes(cameras: Sequence[Camera], ndc: Ndc, resolution: int, planes: int) -> tuple[int, float]:
    """The same of a frustum, by the voxels across it; planes are to stay in proportion to them.

    A pixel is as large as 1/f at a depth of 1, and as wide in normalised device coordinates wherever it looks.

    Args:
        cameras: At training size.
        ndc: The frustum.
        resolution, planes: What is offered.
    """
    pixel = float(np.median([1 / _focal(camera) for camera in cameras])) / math.sqrt(ndc.tan_x * ndc.tan_y)
    across = math.sqrt(resolution**3 / planes)  # vertices along x and along y, see `grid_shape`
    return max(FEWEST, math.ceil(resolution * 2 / (FINEST_VOXEL * pixel) / across)), pixel


def fewer_voxels(
    options: CanonicalOptions, cameras: Sequence[Camera], aabb: Float[Tensor, "2 3"], ndc: Ndc | None = None
) -> tuple[CanonicalOptions, Decision | None]:
    """The options with no more voxels than the pictures show of the box, or of the frustum."""
    if ndc is None:
        needed, pixel = needed_resolution(cameras, aabb)
    else:
        needed, pixel = needed_in_planes(cameras, ndc, options.resolution, options.planes)
    if needed >= options.resolution:
        return options, None
    whole = "box" if ndc is None else "frustum"
    reason = f"a pixel sees 1/{float(aabb[1].sub(aabb[0]).max()) / pixel:.0f} of the {whole}"
    decision = Decision("resolution at rest", str(needed), str(options.resolution), reason)
    return resized(options, needed / options.resolution), decision


def levels_for(options: MotionOptions, canonical: Canonical) -> MotionOptions:
    """The options with levels in proportion to a scene at rest that has been given fewer voxels."""
    ratio = canonical.resolution / options.resolution
    if ratio > NEARLY_ALL:
        return options
    return resized_motion(options, ratio)


def _focal(camera: Camera) -> float:
    """Mean focal length of both axes, pixels."""
    return float(camera.K[[0, 1], [0, 1]].mean())
