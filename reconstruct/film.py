"""A camera path for a film of a scene: an arc through where the training cameras looked from.

Novel views are only good between views that were seen, so the path stays inside the span of the cameras: it
moves in azimuth about the scene's up axis, as far as the cameras reach, and takes its distance and elevation
from the cameras near each azimuth. It looks at the point where the cameras' axes meet. Cameras all
around give a full turn; others a swing there and back, which also makes a loop. Times run evenly, so they
fall between the model's key times too. Everything is in the box frame.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float, Float32, UInt8

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene
from devrf.reconstruct.evaluate import Render

FULL_TURN_GAP = np.radians(100)  # cameras that leave no larger gap than this are all around
SMOOTHING = 0.15  # of the span in azimuth: how far a camera's distance and elevation reach along the path
MARGIN = 0.06  # of the span: left out at both ends of a swing, where views are seen from one side only
ZOOM = 1.0  # focal length against the cameras' median, relative to the picture's larger side


def film_cameras(scene: Scene) -> tuple[Camera, ...]:
    """The cameras whose span the film keeps to: the moving scene's training cameras, else the sweep's.

    Fixed cameras count once each. With fewer than two of them the sweep is used.
    """
    fixed = {f.camera_name: f.camera for f in scene.dynamic if f.split == "train"}
    if len(fixed) >= 2:
        return tuple(fixed.values())
    sweep = tuple(f.camera for f in scene.static if f.split == "train")
    return sweep or tuple(fixed.values())


def orbit(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, max_pixels: int
) -> list[Camera]:
    """A closed path of `count` cameras through the span of `cameras`, without lens distortion.

    Args:
        cameras: In the box frame, at least one.
        aabb: Box corners [2, 3].
        count: Number of pictures.
        max_pixels: Pictures have at most so many, and even sides.
    """
    if not cameras:
        raise ValueError("a camera path needs at least one camera")
    target = focus(cameras, aabb)
    up = _unit(np.mean([-c.cam_from_world[1, :3] for c in cameras], axis=0))
    offsets = np.array([c.centre for c in cameras]) - target
    height = offsets @ up
    flat = offsets - height[:, None] * up
    east = _unit(flat[np.argmax(np.linalg.norm(flat, axis=1))])
    north = np.cross(up, east)
    azimuth = np.arctan2(flat @ north, flat @ east)
    distance = np.linalg.norm(offsets, axis=1)
    elevation = np.arcsin(height / distance)

    start, span, closed = _span(azimuth)
    phase = np.arange(count) / count
    # a swing goes there and back like a pendulum: no jerk at its ends, and the film can loop
    share = phase if closed else MARGIN + (1 - 2 * MARGIN) * (0.5 - 0.5 * np.cos(2 * np.pi * phase))
    path = start + span * share
    lens = _lens(cameras, max_pixels)
    out = []
    for angle in path:
        away = np.abs(_wrap(azimuth - angle))
        width = max(SMOOTHING * span, 1e-3)
        weight = np.exp(-0.5 * (away**2 - away.min() ** 2) / width**2)  # shifted: never all zero
        weight /= weight.sum()
        rise = weight @ elevation
        outward = np.cos(rise) * (np.cos(angle) * east + np.sin(angle) * north) + np.sin(rise) * up
        out.append(_looking_at(lens, target + (weight @ distance) * outward, target, up))
    return out


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


def film_frames(
    render: Render, path: Sequence[Camera], times: Sequence[float | None]
) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Render the path, picture by picture."""
    for camera, time in zip(path, times, strict=True):
        yield to_8_bits(render(camera, time))


def film_times(scene: Scene, count: int) -> list[float | None]:
    """Times that run evenly from the first to the last; None throughout where nothing moves."""
    if not scene.dynamic:
        return [None] * count
    return [float(t) for t in np.linspace(0.0, 1.0, count)]


def to_8_bits(picture: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """A picture in [0, 1] as bytes."""
    return np.clip(np.round(picture * 255), 0, 255).astype(np.uint8)


def _span(azimuth: Float[np.ndarray, " n"]) -> tuple[float, float, bool]:
    """Start and extent (radians) of the arc that leaves out the largest gap; whether it is a full turn."""
    ordered = np.sort(azimuth)
    gaps = np.diff(np.append(ordered, ordered[0] + 2 * np.pi))
    largest = int(np.argmax(gaps))
    if len(ordered) > 2 and gaps[largest] <= FULL_TURN_GAP:
        return float(ordered[0]), 2 * np.pi, True
    start = ordered[(largest + 1) % len(ordered)]
    return float(start), float(2 * np.pi - gaps[largest]), False


def _lens(cameras: Sequence[Camera], max_pixels: int) -> Camera:
    """Median shape and field of view of the cameras; even sides, centred, no distortion."""
    width, height = (float(np.median([getattr(c, side) for c in cameras])) for side in ("width", "height"))
    scale = min(1.0, np.sqrt(max_pixels / (width * height)))
    focal = float(np.median([c.K[0, 0] / max(c.width, c.height) for c in cameras]))
    w, h = (max(2, 2 * int(side * scale / 2)) for side in (width, height))
    f = ZOOM * focal * max(width, height) * scale
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]])
    return Camera(w, h, K, np.eye(4)[:3])


def _looking_at(lens: Camera, position: np.ndarray, target: np.ndarray, up: np.ndarray) -> Camera:
    z = _unit(target - position)
    x = _unit(np.cross(z, up))
    R = np.stack([x, np.cross(z, x), z])
    return Camera(lens.width, lens.height, lens.K, np.column_stack([R, -R @ position]))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _wrap(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
