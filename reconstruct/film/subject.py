"""What a film is to show: the surface that moves, and the way around it on which nothing near hides it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from devrf.capture.camera import Camera
from devrf.reconstruct.geometry.camera_arc import Span
from devrf.reconstruct.geometry.field import moved
from devrf.reconstruct.geometry.paths import MARGIN, orbit, pendulum
from devrf.reconstruct.geometry.seen import look, solid
from devrf.reconstruct.kernels.march import RaySegments, intersect
from devrf.reconstruct.rendering.model import DynamicModel

TIMES = 13  # at which the surface is asked for its place
SIDE_PX = 80  # longer side of the views in which it is looked for
MOST_POINTS = 300
MOVES = 0.03  # of the box's longest half side: what goes less far stands
NEAR = 0.5  # of a point's distance: what is nearer to the camera stands in between, and not beside it
OPAQUE = 0.5
HIDDEN = 0.1  # of the points: from here on a picture does not show the subject
PLACES = 36  # along the way
NEARER = (1.0, 0.85, 0.7, 0.55)  # of the cameras' distance: a way before what stands in between


@dataclass(frozen=True)
class Subject:
    """Points of the surface that move.

    Attributes:
        times: In [0, 1], rising [T].
        ways: Where they are then, in the box frame [T, N, 3].
        telling: The time at which most of it is elsewhere and on its way.
    """

    times: Float[np.ndarray, " T"]
    ways: Float[np.ndarray, "T n 3"]
    telling: float


def subject_of(model: DynamicModel, cameras: Sequence[Camera]) -> Subject | None:
    """What moves of the surface that cameras (in the box frame) see at rest; None: nothing does."""
    if model.motion is None:
        return None
    whole = solid(model)
    views = [
        look(whole, camera.scaled(SIDE_PX / max(camera.width, camera.height)), None) for camera in cameras
    ]
    rest = np.concatenate([view.points[view.kept & np.isfinite(view.points).all(-1)] for view in views])
    times = np.linspace(0.0, 1.0, TIMES)
    ways = np.stack([moved(model, rest, None, float(time)) for time in times])
    far = np.linalg.norm(ways - rest, axis=-1)
    moves = np.flatnonzero(far.max(axis=0) > MOVES)
    if not len(moves):
        return None
    moves = moves[:: -(-len(moves) // MOST_POINTS)]
    speed = np.linalg.norm(np.gradient(ways[:, moves], times, axis=0), axis=-1).mean(axis=1)
    telling = times[np.argmax(far[:, moves].mean(axis=1) * speed)]
    return Subject(times, ways[:, moves], float(telling))


def clear_orbit(
    model: DynamicModel,
    cameras: Sequence[Camera],
    aabb: Float[np.ndarray, "2 3"],
    count: int,
    lens: Camera,
    subject: Subject,
) -> list[Camera]:
    """`orbit`, as far as nothing near hides the subject; closer to it where that passes what does.

    Args:
        cameras, aabb, count, lens: As of `paths.orbit`.
    """
    span = Span.of(cameras, aabb)
    shares = (
        np.arange(PLACES) / PLACES if span.closed else MARGIN + (1 - 2 * MARGIN) * np.linspace(0, 1, PLACES)
    )

    def at(share: float, nearer: float) -> Camera:
        return span.between(lens, float(span.start + span.extent * share), nearer)

    def nearest_that_shows(share: float) -> float:
        shows = (nearer for nearer in NEARER if hidden(model, at(share, nearer), subject) < HIDDEN)
        return next(shows, 0.0)

    nearer = np.array([nearest_that_shows(share) for share in shares])
    if (nearer == 1).all() or not nearer.any():  # where it is hidden everywhere, as cameras saw it
        return orbit(cameras, aabb, count, lens)
    first, length = _longest_run(nearer > 0, span.closed)
    smooth = gaussian_filter1d(
        minimum_filter1d(np.take(nearer, first + np.arange(length), mode="wrap"), 3), 1.5
    )
    along = (length - 1) * pendulum(count)
    step = shares[1] - shares[0]
    return [
        at(shares[first] + step * place, float(np.interp(place, np.arange(length), smooth)))
        for place in along.tolist()
    ]


@torch.no_grad()
def hidden(model: DynamicModel, camera: Camera, subject: Subject, time: float | None = None) -> float:
    """The share of the subject's points that something less than half as far away hides from a camera.

    Args:
        time: In [0, 1], of where the points are; None: all over the clip.
    """
    ways = subject.ways if time is None else subject.ways[[int(np.argmin(np.abs(subject.times - time)))]]
    way = ways.reshape(-1, 3) - camera.centre
    away = np.linalg.norm(way, axis=1)
    rest = model.rest
    device = rest.canonical.density.device
    o = torch.from_numpy(np.tile(camera.centre, (len(way), 1)).astype(np.float32)).to(device)
    d = torch.from_numpy((way / away[:, None]).astype(np.float32)).to(device)
    half = torch.from_numpy((NEAR * away).astype(np.float32)).to(device)
    near = rest.near_for(camera)
    through = torch.ones_like(half)
    if rest.shell is not None:
        t_in, _, _ = intersect(o, d, rest.canonical.aabb, near)
        begin, middle = torch.full_like(half, near), torch.full_like(half, 0.5)
        end = torch.maximum(torch.minimum(t_in, half), begin)
        through = rest.shell.render(RaySegments(o, d, begin, end, middle), False)[1]
    seen = model.box_at_rest(o, d)
    solid_part = 1 - seen.left
    before = (solid_part > OPAQUE) & (seen.depth / solid_part.clamp(min=OPAQUE) < half)
    return float((before | (through < OPAQUE)).float().mean())


def _longest_run(shows: np.ndarray, closed: bool) -> tuple[int, int]:
    """First place and length of the longest run of places that show something; over the end where it is closed."""
    count = len(shows)
    if shows.all():
        return 0, count
    best = (0, 0)
    for first in range(count):
        most = count if closed else count - first
        length = next((k for k in range(most) if not shows[(first + k) % count]), most)
        best = max(best, (first, length), key=lambda run: run[1])
    return best
