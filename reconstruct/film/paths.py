"""Camera paths through the span of the training cameras: around, on a small spiral, nearer and farther.

All of them look at the target and close: the last picture leads to the first again, so a film can loop. Where the
cameras are not all around, a path goes there and back like a pendulum, without a jerk at its ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.reconstruct.film.span import Span

MARGIN = 0.06  # of the span: left out at both ends of a swing, where views are seen from one side only
SPIRAL_TURNS = 2  # in a film, as of LLFF's
SPIRAL_SHARE = 0.25  # of the span in azimuth (and of the cameras' elevations): how far the spiral reaches
SPIRAL_DEG = (2.0, 12.0)  # least and most of it, either way
SPIRAL_DEPTH = 0.06  # of the distance: how far it goes in and out, once a film
DOLLY = (0.7, 1.15)  # of the cameras' distance: nearest and farthest


def orbit(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera
) -> list[Camera]:
    """Around the up axis as far as the cameras reach; distance and elevation follow the cameras nearby.

    Args:
        cameras: In the box frame, at least one.
        aabb: Box corners [2, 3].
        count: Number of pictures.
        lens: A camera with the pictures' size and intrinsics.
    """
    span = Span.of(cameras, aabb)
    share = _phase(count) if span.closed else MARGIN + (1 - 2 * MARGIN) * _pendulum(count)
    out = []
    for azimuth in span.start + span.extent * share:
        elevation, distance = span.near(float(azimuth))
        out.append(span.looking(lens, span.place(float(azimuth), elevation, distance)))
    return out


def spiral(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera
) -> list[Camera]:
    """A small spiral about the middle of the span (after LLFF: Mildenhall et al. 2019); arguments as `orbit`'s."""
    span = Span.of(cameras, aabb)
    middle, elevation, distance = _middle(span)
    least, most = np.radians(SPIRAL_DEG)
    wide = float(np.clip(SPIRAL_SHARE * span.extent, least, most))
    high = float(np.clip(SPIRAL_SHARE * np.ptp(span.elevation), least, wide))
    out = []
    for phase in 2 * np.pi * _phase(count):
        place = span.place(
            middle + wide * np.sin(SPIRAL_TURNS * phase),
            elevation + high * np.cos(SPIRAL_TURNS * phase),
            distance * (1 - SPIRAL_DEPTH * np.sin(phase)),
        )
        out.append(span.looking(lens, place))
    return out


def dolly(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera
) -> list[Camera]:
    """From afar towards the subject and back, in the middle of the span; arguments as `orbit`'s."""
    span = Span.of(cameras, aabb)
    middle, elevation, distance = _middle(span)
    near, far = DOLLY
    ways = distance * (far + (near - far) * _pendulum(count))
    return [span.looking(lens, span.place(middle, elevation, float(way))) for way in ways]


def vertigo(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera
) -> list[Camera]:
    """`dolly` with a zoom against it: what is at the target keeps its size; arguments as `orbit`'s."""
    span = Span.of(cameras, aabb)
    _, _, distance = _middle(span)
    out = []
    for camera in dolly(cameras, aabb, count, lens):
        zoom = float(np.linalg.norm(camera.centre - span.target)) / distance
        out.append(replace(camera, K=camera.K * [[zoom, 1, 1], [1, zoom, 1], [1, 1, 1]]))
    return out


PATHS: dict[str, Callable[..., list[Camera]]] = {
    "orbit": orbit,
    "spiral": spiral,
    "dolly": dolly,
    "vertigo": vertigo,
}
"""By name: `path(cameras, aabb, count, lens)`."""


def _middle(span: Span) -> tuple[float, float, float]:
    """Azimuth, elevation and distance in the middle of the span."""
    azimuth = span.start + span.extent / 2
    return azimuth, *span.near(azimuth)


def _phase(count: int) -> Float[np.ndarray, " count"]:
    """From 0 towards 1, which is the first picture again."""
    return np.arange(count) / count


def _pendulum(count: int) -> Float[np.ndarray, " count"]:
    """From 0 to 1 and back."""
    return 0.5 - 0.5 * np.cos(2 * np.pi * _phase(count))
