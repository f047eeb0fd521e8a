"""Follow surface points through time, away from the moment of rest.

At each moment the graph's pose is predicted (constant velocity) and moved by Gauss-Newton steps to what the cameras
show: optical flow from the picture before, flow from the drawn prediction to the picture, and the brightness of
high-pass pictures itself. Points are always compared with real pictures, mostly of the rest, so errors do not add up.
Pictures count at their exact times: a point of a picture at time t lies on the way between the two moments around it.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from devrf.capture.camera import Camera
from devrf.capture.cores import usable_cores
from devrf.reconstruct.tracking.film import Film, blurred, sampled
from devrf.reconstruct.tracking.graph import Graph, Pose
from devrf.reconstruct.tracking.sight import Sight
from devrf.reconstruct.tracking.solve import Pulls, step
from devrf.reconstruct.tracking.surface import Surface
from devrf.reconstruct.tracking.templates import Templates

SIGMAS = (
    (2.5, 1.2),
    (1.2, 0.0),
)  # pixels by which pictures are blurred, each time the prediction is drawn anew
STEPS = 2  # of Gauss-Newton, of each
LEAST_SIGMA = 0.7  # of a picture that is not blurred, as a weight
CONTRAST = 20.0  # pixels that a brightness of 1 (of the logarithm) is worth
HUBER_FLOW, HUBER_DRAWN, HUBER_CONTRAST = 1.0, 1.5, 0.1  # pixels, pixels, brightness
FEWEST_SEEN = 20  # points, of which a camera says something
LEARN_EVERY = 4  # moments
MOST_MOMENTS = 300  # of a long clip, of which not every picture is looked at


@dataclass(frozen=True)
class Tracks:
    """Where surface points are at moments.

    Attributes:
        times: Moments in the scene's time of [0, 1], rising and evenly spaced [t].
        xyz: Positions [t, p, 3], in the box frame.
    """

    times: Float[np.ndarray, " t"]
    xyz: Float[np.ndarray, "t p 3"]


def follow_both_ways(
    surface: Surface,
    graph: Graph,
    films: Sequence[Film],
    rest_time: float,
    progress: Callable[[float], object] = lambda share: None,
) -> Tracks:
    """Follow points from the time of rest to the end and to the beginning of the films.

    Args:
        surface: Points that move, at rest.
        graph: Of these points.
        films: With what stands in them.
        rest_time: In [0, 1].
        progress: Told how much is done.
    """
    gap = min(float(np.median(np.diff(film.times))) for film in films)
    last = max(float(film.times[-1]) for film in films)
    first = min(float(film.times[0]) for film in films)
    gap = max(gap, (last - first) / MOST_MOMENTS)
    after, before = (
        max(0, int(np.ceil(span / gap - 1e-6))) for span in (last - rest_time, rest_time - first)
    )
    done = 0

    def tell() -> None:
        nonlocal done
        done += 1
        progress(done / (after + before))

    later = _follow(surface, graph, films, rest_time + gap * np.arange(after + 1), tell)
    back = [film.backwards() for film in films]
    earlier = _follow(surface, graph, back, -rest_time + gap * np.arange(before + 1), tell)
    xyz = np.concatenate([earlier[:0:-1], later]).astype(np.float32)
    return Tracks(rest_time + gap * np.arange(-before, after + 1), xyz)


def _follow(
    surface: Surface,
    graph: Graph,
    films: Sequence[Film],
    times: Float[np.ndarray, " t"],
    tell: Callable[[], object],
) -> Float[np.ndarray, "t p 3"]:
    side_by_side = all(film.estimator.parallel for film in films)
    with ThreadPoolExecutor(min(len(films), usable_cores()) if side_by_side else 1) as pool:
        return _followed(surface, graph, films, times, tell, pool)


def _followed(
    surface: Surface,
    graph: Graph,
    films: Sequence[Film],
    times: Float[np.ndarray, " t"],
    tell: Callable[[], object],
    pool: ThreadPoolExecutor,
) -> Float[np.ndarray, "t p 3"]:
    pose = before = Pose.rest(len(graph.nodes))
    now = was = surface.xyz
    out = [now]
    gap = float(times[1] - times[0]) if len(times) > 1 else 1.0
    templates = [Templates(film, len(surface)) for film in films]
    for known in templates:
        n = known.film.nearest(times[0], gap)
        if n is not None:
            known.learn(n, Sight(known.film, now, surface.normals, surface.spacing), 1)
    for moment, time in enumerate(times[1:], 1):
        shots = []
        for known in templates:
            n = known.film.nearest(time, gap / 2 + 1e-9)
            if n is not None:
                shots.append(_Shot(known, n, 1 + (float(known.film.times[n]) - time) / gap))
        normals = graph.turned(pose, surface.normals)
        flown = [shot for shot in shots if shot.n > 0]
        shares = [1 + (float(s.film.times[s.n - 1]) - float(times[moment - 1])) / gap for s in flown]
        _each(
            pool.submit(shot.come, was + share * (now - was), normals, surface.spacing)
            for shot, share in zip(flown, shares, strict=True)
        )
        expected = _ahead(before, pose)
        found = expected
        for sigmas in SIGMAS:
            xyz = graph.points(found)
            normals = graph.turned(found, surface.normals)
            _each(
                pool.submit(shot.look, now + shot.share * (xyz - now), normals, surface, sigmas)
                for shot in shots
            )
            for _ in range(STEPS):
                xyz = graph.points(found)
                pulls = _Sum(len(surface))
                for shot in shots:
                    shot.pull(now + shot.share * (xyz - now), pulls)
                found = step(graph, found, expected, pulls.all())
        before, pose = pose, found
        was, now = now, graph.points(pose)
        out.append(now)
        if moment % LEARN_EVERY == 0:
            normals = graph.turned(pose, surface.normals)
            for shot in shots:
                xyz = was + shot.share * (now - was)
                shot.templates.learn(shot.n, Sight(shot.film, xyz, normals, surface.spacing))
        tell()
    return np.stack(out)


def _each(begun: Iterable[Future[None]]) -> None:
    """Wait for pictures of different cameras, which are looked at side by side."""
    for done in list(begun):
        done.result()


class _Sum:
    """Quadratics of points, added up."""

    def __init__(self, points: int) -> None:
        self.hessian, self.gradient = np.zeros((points, 3, 3)), np.zeros((points, 3))

    def add(self, points: np.ndarray, jacobian: np.ndarray, residual: np.ndarray, weight: np.ndarray) -> None:
        """Add weighted squares of residuals [m, r] of points with derivatives [m, r, 3]; each point at most once."""
        fine = np.isfinite(residual).all(1) & np.isfinite(jacobian).all((1, 2)) & np.isfinite(weight)
        points, jacobian, residual, weight = (x[fine] for x in (points, jacobian, residual, weight))
        weighted = jacobian * weight[:, None, None]
        self.hessian[points] += np.einsum("mra,mrb->mab", jacobian, weighted)
        self.gradient[points] += np.einsum("mra,mr->ma", weighted, residual)

    def all(self) -> Pulls:
        """What all of them want."""
        return Pulls(self.hessian, self.gradient)


@dataclass
class _Contrast:
    """Brightness of a drawn and of a real picture at points, to first order around their pixels."""

    apart: Float[np.ndarray, "m 3"]
    slope: Float[np.ndarray, "m 3 2"]
    weight: float


class _Shot:
    """One picture at one moment: what it says of the points that its camera sees."""

    def __init__(self, templates: Templates, n: int, share: float) -> None:
        self.templates, self.film, self.n, self.share = templates, templates.film, n, share
        none = np.zeros(0, dtype=int)
        self.came: tuple[np.ndarray, np.ndarray, np.ndarray] = none, np.zeros((0, 2)), np.zeros(0)
        self.points: Int[np.ndarray, " m"] = none

    def come(self, xyz: np.ndarray, normals: np.ndarray, spacing: float) -> None:
        """Where optical flow brings points from the picture before, in which they are at `xyz`."""
        sight = Sight(self.film, xyz, normals, spacing)
        points = np.flatnonzero(sight.seen)
        if len(points) < FEWEST_SEEN:
            return
        flow, missed = self.film.flow(self.film.sharp(self.n - 1), self.film.sharp(self.n))
        at = sight.at[points]
        self.came = points, at + sampled(flow, at), np.exp(-(sampled(missed, at) ** 2))

    def look(self, xyz: np.ndarray, normals: np.ndarray, surface: Surface, sigmas: tuple[float, ...]) -> None:
        """Draw what the picture should show with points at `xyz`, and hold it against the picture."""
        sight = Sight(self.film, xyz, normals, surface.spacing)
        self.points = self.templates.known(sight)
        if len(self.points) < FEWEST_SEEN:
            self.points = self.points[:0]
            return
        self.at = sight.at[self.points]
        drawn = self.film.high_pass(self.templates.draw(sight, surface.rgb.astype(np.float32)))
        real = self.film.sharp(self.n)
        flow, missed = self.film.flow(drawn, real)
        self.flow = self.at + sampled(flow, self.at), np.exp(-(sampled(missed, self.at) ** 2))
        self.contrasts = []
        for sigma in sigmas:
            one, other = blurred(drawn, sigma), blurred(real, sigma)
            along, down = np.gradient(one + other, axis=1), np.gradient(one + other, axis=0)
            gradient = 0.5 * np.stack([along, down], -1)
            slope = sampled(gradient.reshape(*one.shape[:2], -1), self.at).reshape(-1, 3, 2)
            apart = sampled(other, self.at) - sampled(one, self.at)
            self.contrasts.append(_Contrast(apart, slope, max(sigma, LEAST_SIGMA)))

    def pull(self, xyz: np.ndarray, pulls: _Sum) -> None:
        """Add what the picture wants of points that are at `xyz` when it is taken."""
        camera = self.film.camera
        points, target, weight = self.came
        if len(points):
            residual = camera.project(xyz[points]) - target
            weight = weight * _huber(np.linalg.norm(residual, axis=1), HUBER_FLOW)
            pulls.add(points, _derivative(camera, xyz[points]) * self.share, residual, weight)
        if not len(self.points):
            return
        derivative = _derivative(camera, xyz[self.points]) * self.share
        at = camera.project(xyz[self.points])
        target, weight = self.flow
        weight = weight * _huber(np.linalg.norm(at - target, axis=1), HUBER_DRAWN)
        pulls.add(self.points, derivative, at - target, weight)
        for contrast in self.contrasts:
            residual = contrast.apart + np.einsum("mij,mj->mi", contrast.slope, at - self.at)
            weight = contrast.weight * _huber(np.abs(residual).max(1), HUBER_CONTRAST)
            jacobian = CONTRAST * np.einsum("mij,mjk->mik", contrast.slope, derivative)
            pulls.add(self.points, jacobian, CONTRAST * residual, weight)


def _ahead(before: Pose, now: Pose) -> Pose:
    """The pose that comes if everything goes on as it went."""
    turn = now.rotations @ before.rotations.transpose(0, 2, 1)
    rotations = Rotation.from_matrix(turn @ now.rotations).as_matrix()  # a rotation again, to all digits
    return Pose(rotations, 2 * now.shifts - before.shifts)


def _derivative(camera: Camera, xyz: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2 3"]:
    """Of pixels by points, without the lens's distortion, which changes little from pixel to pixel."""
    R = camera.cam_from_world[:, :3]
    x, y, z = (xyz @ R.T + camera.cam_from_world[:, 3]).T
    fx, fy, zero = camera.K[0, 0], camera.K[1, 1], np.zeros_like(z)
    rows = [[fx / z, zero, -fx * x / z**2], [zero, fy / z, -fy * y / z**2]]
    return np.stack([np.stack(row, -1) for row in rows], -2) @ R


def _huber(length: np.ndarray, least: float) -> np.ndarray:
    """Weight of a residual of a length: 1, and less beyond `least` (Huber 1964)."""
    return np.minimum(1, least / np.maximum(length, 1e-9))
