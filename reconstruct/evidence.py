"""What the training pictures know of points of the scene: who sees them, from where, and how well they are explained.

A *witness* is a training picture rendered anew at a quarter of its size: its depth says what it sees, its difference
from the true picture how well the model explains it there. Sweep pictures witness the scene at rest, pictures of
the moving cameras the motion. A point at time t is taken to its place at rest by the backward motion and from there
to the witness' own time by the forward motion. Test pictures are never read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.model import DynamicModel, render_layers
from devrf.reconstruct.pictures import clips, spread, training

WITNESS_SCALE = 1 / 4
MOST_OF_SWEEP = 10  # witnesses at rest, spread over the sweep
MOST_OF_MOTION = 12  # witnesses in motion, over all cameras
LEAST_PER_CAMERA = 3  # the first, which is mostly at rest, one in the middle and the last
FEWEST_PX = 32  # of its longer side: with less it cannot tell what hides what
SAME_SURFACE = 0.03  # of the distance: a point farther behind what a witness sees is hidden from it
SOLID = 0.5  # opacity from which a pixel shows a surface


@dataclass(frozen=True)
class Witness:
    """A training picture, small.

    Attributes:
        frame: Which.
        camera: At the small size, in the box frame.
        focal_px: Focal length at the training size.
        depth: Distance of the surface seen; infinite where it sees through the box.
        residual: Mean squared difference from the true picture, over channels.
    """

    frame: PosedFrame
    camera: Camera
    focal_px: float
    depth: Float[np.ndarray, "h w"]
    residual: Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class Places:
    """Surface points at a time: where they are, where they rest, and how far the motion's cycle misses.

    Attributes:
        now, at_rest: In the box frame.
        grid: At rest, in the coordinates of the model's grids.
        cycle: Distance from `now` to where backward and then forward motion lead.
    """

    now: Float[np.ndarray, "n 3"]
    at_rest: Float[np.ndarray, "n 3"]
    grid: Float[Tensor, "n 3"]
    cycle: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Sightings:
    """What witnesses say of points.

    Attributes:
        count: How many see each.
        information: Of its position, if each sighting is true to a pixel: the sum of (f/r)^2 (I - v v^T) over
            those who see it, for a line of sight v of length r (the inverse is the covariance).
        residual: Mean of their squared differences there; NaN where nobody sees it.
    """

    count: Int[np.ndarray, " n"]
    information: Float[np.ndarray, "n 3 3"]
    residual: Float[np.ndarray, " n"]


class Evidence:
    """Witnesses of the scene at rest and of its motion.

    Args:
        scene: In the box frame.
        model: As it is rendered.
    """

    def __init__(self, scene: Scene, model: DynamicModel) -> None:
        self.model = model
        self.sweep = tuple(_witness(scene, model, f) for f in spread(training(scene.static), MOST_OF_SWEEP))
        self.fixed: dict[str, tuple[Witness, ...]] = {}
        moving = clips(scene) if model.motion is not None else {}
        for name, clip in moving.items():
            chosen = spread(clip, max(LEAST_PER_CAMERA, MOST_OF_MOTION // len(moving)))
            self.fixed[name] = tuple(_witness(scene, model, f) for f in chosen)

    def places(self, points: Float[np.ndarray, "n 3"], time: float | None) -> Places:
        """Where points seen at a time (None: at rest) rest."""
        model, ndc = self.model, self.model.rest.canonical.ndc
        device = model.rest.canonical.density.device
        x = torch.from_numpy(points.astype(np.float32)).to(device)
        x = x if ndc is None else ndc.from_world(x)
        if model.motion is None or time is None:
            return Places(points, points, x, np.zeros(len(points)))
        motion, tau = model.motion.at(time, str(device))
        taus = tau.expand(len(x)).contiguous()
        x0 = motion.to_rest(x, taus)
        again = self._world(motion.from_rest(x0, taus))
        return Places(points, self._world(x0), x0, np.linalg.norm(again - points, axis=1))

    def of_rest(self, places: Places, besides: PosedFrame | None = None) -> Sightings:
        """What the sweep says of points where they rest.

        Args:
            places: The points.
            besides: A picture whose differences do not count: what is asked about is itself.
        """
        return _sightings([(w, places.at_rest) for w in self.sweep], len(places.now), lambda f: f is besides)

    def of_motion(self, places: Places, time: float, besides: PosedFrame | None = None) -> Sightings:
        """What each moving camera's picture nearest in time says of points; as `of_rest`.

        Of `besides` the differences of its whole camera do not count.
        """
        seen = []
        for witnesses in self.fixed.values():
            nearest = min(witnesses, key=lambda w: abs((w.frame.time or 0.0) - time))
            seen.append((nearest, self._at(places, nearest.frame.time or 0.0)))
        name = None if besides is None else besides.camera_name
        return _sightings(seen, len(places.now), lambda f: f.camera_name == name)

    def _at(self, places: Places, time: float) -> Float[np.ndarray, "n 3"]:
        """Where resting points are at another time."""
        assert self.model.motion is not None
        motion, tau = self.model.motion.at(time, places.grid.device)
        return self._world(motion.from_rest(places.grid, tau.expand(len(places.grid)).contiguous()))

    def _world(self, x: Tensor) -> Float[np.ndarray, "n 3"]:
        ndc = self.model.rest.canonical.ndc
        return (x if ndc is None else ndc.to_world(x)).cpu().numpy().astype(np.float64)


def witness_scale(camera: Camera, image_scale: float) -> float:
    """Relative size of a witness."""
    longest = max(camera.width, camera.height) * image_scale
    return image_scale * min(1.0, max(WITNESS_SCALE, FEWEST_PX / longest))


def _witness(scene: Scene, model: DynamicModel, frame: PosedFrame) -> Witness:
    scale = witness_scale(frame.camera, scene.image_scale)
    camera = frame.camera.scaled(scale)
    picture, depth, opacity = render_layers(model, camera, frame.time)
    true = load_image(frame, scale, scene.background).astype(np.float32) / 255
    surface = np.where(opacity > SOLID, depth / np.maximum(opacity, SOLID), np.inf)
    focal_px = float(frame.camera.K[0, 0] * scene.image_scale)
    return Witness(frame, camera, focal_px, surface, ((picture - true) ** 2).mean(-1))


def _sightings(
    seen: Sequence[tuple[Witness, Float[np.ndarray, "n 3"]]], n: int, is_own: Callable[[PosedFrame], bool]
) -> Sightings:
    """Sum up over witnesses; each has the points where they are at its own time."""
    count, information = np.zeros(n, int), np.zeros((n, 3, 3))
    residual, told = np.zeros(n), np.zeros(n)
    for witness, points in seen:
        sees, error = _looks_at(witness, points)
        count[sees] += 1
        away = points[sees] - witness.camera.centre
        squares = (away**2).sum(1)[:, None, None]
        across = np.eye(3) - away[:, :, None] * away[:, None, :] / squares
        information[sees] += witness.focal_px**2 / squares * across
        if not is_own(witness.frame):
            residual[sees] += error
            told[sees] += 1
    return Sightings(count, information, np.where(told > 0, residual / np.maximum(told, 1), np.nan))


def _looks_at(
    witness: Witness, points: Float[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Which points are in the picture and not hidden there, and the picture's squared difference at them."""
    height, width = witness.depth.shape
    pixel = np.nan_to_num(witness.camera.project(points), nan=-1.0)
    inside = np.flatnonzero(((pixel >= 0) & (pixel < [width, height])).all(-1))
    u, v = pixel[inside].astype(int).T
    distance = np.linalg.norm(points[inside] - witness.camera.centre, axis=1)
    free = distance <= (1 + SAME_SURFACE) * witness.depth[v, u]
    return inside[free], witness.residual[v[free], u[free]]
