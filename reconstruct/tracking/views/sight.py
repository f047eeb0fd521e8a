"""Which surface points a camera sees: points are drawn as small squares, the nearest one counts."""

import numpy as np
from jaxtyping import Bool, Float

from devrf.capture.camera import Camera
from devrf.reconstruct.tracking.surface import SurfacePoints
from devrf.reconstruct.tracking.views.film import CameraFilm

BEHIND = 0.03  # box units: what stands hides what is farther behind it than this
SLACK = 0.05  # box units: points this little behind the one that is drawn are seen, too
FACING = 0.15  # cosine between the normal and the direction to the camera
LARGEST = 4  # pixels: half the side of a square


class Sight:
    """What a film's camera sees of points at a moment.

    Attributes:
        ids: Point drawn at each pixel, -1: none [h, w].
        depth: Along the optical axis, of what hides at each pixel: the points, or what stands [h, w].
        at: Of the points in the picture, pixels [n, 2]; NaN behind the camera.
        seen: Whether a point is seen [n].
    """

    def __init__(self, film: CameraFilm, surface: SurfacePoints) -> None:
        camera, xyz = film.camera, surface.xyz
        self.at = camera.project(xyz)
        z = depth_of(camera, xyz)
        self.ids, depth = _drawn(film, self.at, z, surface.spacing)
        self.depth = np.minimum(depth, film.depth)
        size = np.array([camera.width, camera.height])
        inside = np.all((self.at > 1) & (self.at < size - 1), axis=1)  # NaN is not
        pixel = np.where(inside[:, None], self.at, 0).astype(int)
        x, y = pixel.T
        drawn = self.ids[y, x] >= 0
        self.seen = inside & faces(camera, xyz, surface.normals) & drawn & (z < depth[y, x] + SLACK)
        self.pixel = pixel


def depth_of(camera: Camera, xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Depth of points along the optical axis."""
    return (xyz @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3])[:, 2]


def faces(
    camera: Camera, xyz: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Bool[np.ndarray, " n"]:
    """Whether surfaces at points show their front to a camera."""
    towards = camera.centre - xyz
    return (towards * normals).sum(1) > FACING * np.linalg.norm(towards, axis=1)


def _drawn(film: CameraFilm, at: np.ndarray, z: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The point at each pixel, -1 where there is none or what stands hides it, and its depth."""
    camera = film.camera
    width, height = camera.width, camera.height
    near = np.isfinite(at).all(1) & (z > 0)
    near &= ((at > -LARGEST) & (at < np.array([width, height]) + LARGEST)).all(1)
    points = np.flatnonzero(near)
    # Of several points for a pixel the last one stays: the nearest.
    points = points[np.argsort(-z[points], kind="stable")]
    radius = np.clip(np.ceil(0.5 * spacing * camera.K[0, 0] / z[points]), 1, LARGEST).astype(int)  # rises
    margin = 2 * LARGEST  # no square of these points ends beyond it
    wide = width + 2 * margin
    ids = np.full((height + 2 * margin) * wide, -1)
    centre = (np.floor(at[points]).astype(int) + margin) @ [1, wide]
    for r in np.unique(radius):
        y, x = np.mgrid[-r : r + 1, -r : r + 1]
        disc = (y * wide + x)[x * x + y * y <= r * r + 1]
        mine = radius == r
        ids[centre[mine, None] + disc] = points[mine, None]
    ids = ids.reshape(-1, wide)[margin:-margin, margin:-margin]
    depth = np.where(ids >= 0, z[ids], np.inf)
    ids = np.where(film.depth < depth - BEHIND, -1, ids)
    return ids, depth
