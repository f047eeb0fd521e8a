"""Where a scene's cameras looked from, as seen from what they look at: the span that a film keeps to.

A place is told by its azimuth about the scene's up axis, its elevation above the horizontal plane through the
target, and its distance from the target, the point where the cameras' axes meet.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.capture.view_axes import look_at
from devrf.reconstruct.sampling.pictures import training

FULL_TURN_GAP = np.radians(100)  # cameras that leave no larger gap than this are all around
SMOOTHING = 0.15  # of the span in azimuth: how far a camera's distance and elevation reach along the path


@dataclass(frozen=True)
class Span:
    """Where cameras looked from.

    Attributes:
        target: What they look at [3].
        up, east, north: Axes [3]; azimuth is 0 towards `east` and grows towards `north`.
        azimuth, elevation: Of every camera [n], radians.
        distance: Of every camera from the target [n].
        start, extent: The arc of azimuth that they leave no large gap in, radians.
        closed: It is a full turn.
    """

    target: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]
    east: Float[np.ndarray, "3"]
    north: Float[np.ndarray, "3"]
    azimuth: Float[np.ndarray, " n"]
    elevation: Float[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    start: float
    extent: float
    closed: bool

    @staticmethod
    def of(cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"]) -> "Span":
        """The span of at least one camera; box corners [2, 3]."""
        if not cameras:
            raise ValueError("a camera path needs at least one camera")
        target = focus(cameras, aabb)
        up = unit(np.mean([-c.cam_from_world[1, :3] for c in cameras], axis=0))
        offsets = np.array([c.centre for c in cameras]) - target
        flat = offsets - (offsets @ up)[:, None] * up
        east = unit(flat[np.argmax(np.linalg.norm(flat, axis=1))])
        north = np.cross(up, east)
        azimuth, elevation, distance = _angles(offsets, up, east, north)
        return Span(target, up, east, north, azimuth, elevation, distance, *_arc(azimuth))

    def near(self, azimuth: float) -> tuple[float, float]:
        """Elevation and distance that cameras have near an azimuth."""
        away = np.abs(wrap(self.azimuth - azimuth))
        width = max(SMOOTHING * self.extent, 1e-3)
        weight = np.exp(-0.5 * (away**2 - away.min() ** 2) / width**2)  # shifted: never all zero
        weight /= weight.sum()
        return float(weight @ self.elevation), float(weight @ self.distance)

    def place(self, azimuth: float, elevation: float, distance: float) -> Float[np.ndarray, "3"]:
        """The position [3] that is told so."""
        flat = np.cos(azimuth) * self.east + np.sin(azimuth) * self.north
        return self.target + distance * (np.cos(elevation) * flat + np.sin(elevation) * self.up)

    def between(self, lens: Camera, azimuth: float, nearer: float = 1.0) -> Camera:
        """A camera at an azimuth as high and as far away as the cameras nearby, times `nearer`."""
        elevation, distance = self.near(azimuth)
        return self.looking(lens, self.place(azimuth, elevation, nearer * distance))

    def looking(self, lens: Camera, position: Float[np.ndarray, "3"]) -> Camera:
        """A camera that looks at the target, up being up in its picture."""
        return replace(lens, cam_from_world=look_at(position, self.target, self.up))


def film_cameras(scene: Scene) -> tuple[Camera, ...]:
    """The cameras whose span the film keeps to: the moving scene's training cameras, else the sweep's.

    Fixed cameras count once each. With fewer than two of them the sweep is used.
    """
    fixed = fixed_cameras(scene)
    if len(fixed) >= 2:
        return tuple(fixed.values())
    sweep = tuple(f.camera for f in training(scene.static))
    return sweep or tuple(fixed.values())


def fixed_cameras(scene: Scene) -> dict[str, Camera]:
    """The moving scene's training cameras by name."""
    return {f.camera_name: f.camera for f in training(scene.dynamic)}


def focus(cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "3"]:
    """The point [3] nearest to all cameras' axes, within the box (the box's centre draws a little)."""
    axes = np.array([c.cam_from_world[2, :3] for c in cameras])
    centres = np.array([c.centre for c in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    middle = aabb.mean(0)
    pull = 1e-2 * len(cameras)  # decides along the axis where all of them are parallel
    A = across.sum(0) + pull * np.eye(3)
    b = (across @ centres[:, :, None]).sum(0)[:, 0] + pull * middle
    return np.clip(np.linalg.solve(A, b), aabb[0], aabb[1])


def film_lens(
    cameras: Sequence[Camera], most_pixels: int | None = None, size: tuple[int, int] | None = None
) -> Camera:
    """A pinhole camera with the cameras' median field of view along the longer side, without lens distortion.

    Args:
        cameras: At least one.
        most_pixels: It has the cameras' median shape, at most so many pixels, and even sides.
        size: Width and height, instead.
    """
    width, height = (float(np.median([getattr(c, side) for c in cameras])) for side in ("width", "height"))
    focal = float(np.median([c.K[0, 0] / max(c.width, c.height) for c in cameras]))
    if size is not None:
        w, h = size
        f = focal * max(w, h)
    else:
        scale = 1.0 if most_pixels is None else min(1.0, np.sqrt(most_pixels / (width * height)))
        w, h = (max(2, 2 * int(side * scale / 2)) for side in (width, height))
        f = focal * max(width, height) * scale
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]])
    return Camera(w, h, K, np.eye(4)[:3])


def unit(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The vector at length 1."""
    return v / np.linalg.norm(v)


def wrap(angle: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _angles(
    offsets: np.ndarray, up: np.ndarray, east: np.ndarray, north: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    distance = np.linalg.norm(offsets, axis=1)
    elevation = np.arcsin(np.clip(offsets @ up / np.maximum(distance, 1e-12), -1, 1))
    return np.arctan2(offsets @ north, offsets @ east), elevation, distance


def _arc(azimuth: Float[np.ndarray, " n"]) -> tuple[float, float, bool]:
    """Start and extent (radians) of the arc that leaves out the largest gap; whether it is a full turn."""
    ordered = np.sort(azimuth)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    largest = int(np.argmax(gaps))
    if len(ordered) > 2 and gaps[largest] <= FULL_TURN_GAP:
        return float(ordered[0]), 2 * np.pi, True
    start = ordered[(largest + 1) % len(ordered)]
    return float(start), float(2 * np.pi - gaps[largest]), False
