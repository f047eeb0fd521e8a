"""Camera paths: around and on a small spiral within the span of the training cameras, or through given key frames.

`orbit` and `spiral` look at the target and close: the last picture leads to the first again, so a film can loop. Where
the cameras are not all around, the orbit goes there and back like a pendulum, without a jerk at its ends.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from devrf.capture.camera import Camera
from devrf.reconstruct.geometry.camera_arc import Span

MARGIN = 0.06  # of the span: left out at both ends of a swing, where views are seen from one side only
SPIRAL_TURNS = 2  # in a film, as of LLFF's
SPIRAL_SHARE = 0.25  # of the span in azimuth (and of the cameras' elevations): how far the spiral reaches
SPIRAL_DEG = (2.0, 12.0)  # least and most of it, either way
SPIRAL_DEPTH = 0.06  # of the distance: how far it goes in and out, once a film


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
    share = _phase(count) if span.closed else MARGIN + (1 - 2 * MARGIN) * pendulum(count)
    return [span.between(lens, azimuth) for azimuth in (span.start + span.extent * share).tolist()]


def spiral(
    cameras: Sequence[Camera], aabb: Float[np.ndarray, "2 3"], count: int, lens: Camera
) -> list[Camera]:
    """A small spiral about the middle of the span (after LLFF: Mildenhall et al. 2019); arguments as `orbit`'s."""
    span = Span.of(cameras, aabb)
    middle = span.start + span.extent / 2
    elevation, distance = span.near(middle)
    least, most = np.radians(SPIRAL_DEG)
    wide = float(np.clip(SPIRAL_SHARE * span.extent, least, most))
    high = float(np.clip(SPIRAL_SHARE * np.ptp(span.elevation), least, wide))
    out = []
    for angle in 2 * np.pi * _phase(count):
        place = span.place(
            middle + wide * np.sin(SPIRAL_TURNS * angle),
            elevation + high * np.cos(SPIRAL_TURNS * angle),
            distance * (1 - SPIRAL_DEPTH * np.sin(angle)),
        )
        out.append(span.looking(lens, place))
    return out


PATHS: dict[str, Callable[..., list[Camera]]] = {
    "orbit": orbit,
    "spiral": spiral,
}
"""By name: `path(cameras, aabb, count, lens)`."""


def through(views: Sequence[Camera], at: Float[np.ndarray, " count"]) -> list[Camera]:
    """Key frames, met at 0, 1, 2, …, and what lies between them.

    Positions and focal lengths run on monotone cubic splines (Fritsch & Carlson, SIAM J. Numer. Anal. 1980), which
    stay between their knots, rotations on those of scipy's `RotationSpline`.

    Args:
        views: At least one, of one size.
        at: Places of the pictures among them [count].
    """
    if len(views) == 1:
        return [views[0]] * len(at)
    knots = np.arange(len(views), dtype=np.float64)
    places, lenses = (
        PchipInterpolator(knots, np.array(values))(at)
        for values in ([view.centre for view in views], [view.K for view in views])
    )
    R = RotationSpline(knots, Rotation.from_matrix(np.array([view.cam_from_world[:, :3] for view in views])))
    return [
        replace(views[0], K=K, cam_from_world=np.column_stack([turn, -turn @ place]))
        for K, turn, place in zip(lenses, R(at).as_matrix(), places, strict=True)
    ]


def _phase(count: int) -> Float[np.ndarray, " count"]:
    """From 0 towards 1, which is the first picture again."""
    return np.arange(count) / count


def pendulum(count: int) -> Float[np.ndarray, " count"]:
    """From 0 to 1 and back."""
    return 0.5 - 0.5 * np.cos(2 * np.pi * _phase(count))
