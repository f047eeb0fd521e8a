"""How sure a rendered picture is: how many cameras see what it shows, and how well their pictures are explained there.

A *witness* is every fourth pixel of a training picture in both directions, rendered anew: its depth says what it sees,
its residual map (squared differences from the true picture) how well the model explains that. Sweep pictures witness
the scene at rest, pictures of the moving cameras the motion. A point at time t is taken to its place at rest by the
backward motion and from there to the witness' own time by the forward motion. Test pictures are never read, and
nothing is fitted.

The expected squared error of a pixel with opacity a that shows a point is

    a (r + u (4^-s + m 4^-c)) + (1 - a) b

    r   mean residual of the moving cameras that see the point at that time, else of the sweep witnesses that see it
        where it rests, else of all points
    u   variance of the true pictures: what one is wrong by who knows nothing but their mean colour
    s   sweep witnesses that see the point where it rests: each halves the error of a guess
    c   moving cameras that see it at that time; m is 1 where it moves by a pixel or more, else 0
    b   mean residual of what witnesses see through the box; the median before a plain background, where all that
        differs is surface that the model lacks
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.geometry.field import moved
from devrf.reconstruct.model import SOLID, DynamicModel, Layers, render_layers
from devrf.reconstruct.pictures import clips, spread, training

EVERY = 4  # pixel of a training picture, in both directions, is what its witness has
MOST_OF_SWEEP = 10  # witnesses at rest, spread over the sweep
MOST_OF_MOTION = 12  # witnesses in motion, over all cameras
LEAST_PER_CAMERA = 3  # the first, which is mostly at rest, one in the middle and the last
FEWEST_PX = 32  # of its longer side: with less it cannot tell what hides what
SAME_SURFACE = 0.03  # of the distance: a point farther behind what a witness sees is hidden from it
MOST_POINTS = 60_000  # of a picture: of larger ones every n-th pixel in each direction is asked
LEAST_STRIDE = 2  # pixels: what is known of neighbours hardly differs, and a quarter of them costs a quarter
LEAST = 1e-5  # a squared error of a grey level: less cannot be told from rounding


@dataclass(frozen=True)
class Witness:
    """A training picture, small.

    Attributes:
        time: Of it; None: at rest.
        camera: At the small size, in the box frame.
        pixel_rad: Angle of a pixel of the training size.
        depth: Distance of the surface seen; infinite where it sees through the box.
        residual: Mean squared difference from the true picture, over channels.
        variance: Of the true picture's pixels, mean over channels.
    """

    time: float | None
    camera: Camera
    pixel_rad: float
    depth: Float[np.ndarray, "h w"]
    residual: Float[np.ndarray, "h w"]
    variance: float


@dataclass(frozen=True)
class Seen:
    """What is known of what every n-th pixel of a picture shows, as maps of these pixels.

    Attributes:
        opacity: Of the pixels.
        moves: Whether the point is a pixel of the training pictures or more away from where it rests.
        in_sweep: Sweep witnesses that see it.
        in_motion: Moving cameras that see it at that time.
        expected: Expected squared error of the point, whatever is behind it.
    """

    opacity: Float64[np.ndarray, "rows columns"]
    moves: Bool[np.ndarray, "rows columns"]
    in_sweep: Int[np.ndarray, "rows columns"]
    in_motion: Int[np.ndarray, "rows columns"]
    expected: Float64[np.ndarray, "rows columns"]


class Confidence:
    """Expected errors of pictures of a model.

    Args:
        scene: Only its training pictures are read; cameras in any frame.
        model: As it is rendered.
    Attributes:
        sweep: Witnesses of the scene at rest.
        fixed: Witnesses of the motion, by camera.
    """

    def __init__(self, scene: Scene, model: DynamicModel) -> None:
        scene = scene.in_box_frame()
        self.model = model
        self.sweep = [_witness(scene, model, f) for f in spread(training(scene.static), MOST_OF_SWEEP)]
        self.fixed: dict[str, list[Witness]] = {}
        moving = clips(scene) if model.motion is not None else {}
        for name, clip in moving.items():
            chosen = spread(clip, max(LEAST_PER_CAMERA, MOST_OF_MOTION // len(moving)))
            self.fixed[name] = [_witness(scene, model, f) for f in chosen]
        witnesses = self.sweep + [w for clip in self.fixed.values() for w in clip]
        residual = np.concatenate([w.residual.reshape(-1) for w in witnesses])
        through = np.isinf(np.concatenate([w.depth.reshape(-1) for w in witnesses]))
        self._typical = float(residual[~through].mean()) if not through.all() else 0.0
        middle = np.median if model.rest.shell is None else np.mean
        self._behind = float(middle(residual[through])) if through.any() else 0.0
        self._guess = float(np.mean([w.variance for w in witnesses]))
        self._pixel_rad = float(np.median([w.pixel_rad for w in witnesses]))

    def render(self, camera: Camera, time: float | None) -> Layers:
        """RGB, depth and opacity of a camera in the box frame at a time in [0, 1]; None: the scene at rest."""
        return render_layers(self.model, camera, time)

    def expected(self, camera: Camera, time: float | None, layers: Layers) -> Float32[np.ndarray, "h w"]:
        """Root of each pixel's expected squared error (mean over channels), of the full range.

        Args:
            camera, time: As rendered.
            layers: What `render` gave.
        """
        opacity = layers[2]
        point = self.seen(camera, time, layers).expected
        rows, columns = (np.arange(n) // _stride(opacity) for n in opacity.shape)
        squared = opacity * point[np.ix_(rows, columns)] + (1 - opacity) * self._behind
        return np.sqrt(np.clip(squared, LEAST, 1.0)).astype(np.float32)

    def seen(self, camera: Camera, time: float | None, layers: Layers) -> Seen:
        """Who sees what a picture shows, and how wrong it may be; arguments as `expected`."""
        _, depth, opacity = layers
        stride = _stride(opacity)
        rows, columns = (np.minimum(np.arange(0, n, stride) + stride // 2, n - 1) for n in opacity.shape)
        solid = opacity[np.ix_(rows, columns)].astype(np.float64)
        away = depth[np.ix_(rows, columns)].reshape(-1, 1) / np.maximum(solid.reshape(-1, 1), SOLID)
        pixels = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1).reshape(-1, 2)
        now = camera.centre + away * camera.directions(pixels)
        rest = moved(self.model, now, time, None)
        moves = np.linalg.norm(now - rest, axis=1) > self._pixel_rad * away[:, 0]
        in_sweep, of_sweep = _sightings([(w, rest) for w in self.sweep], len(now))
        in_motion, of_motion = _sightings(self._in_motion(now, time), len(now))
        residual = np.where(in_sweep > 0, of_sweep, self._typical)
        residual = np.where(in_motion > 0, of_motion, residual)
        unsure = np.where(moves, 0.25**in_motion, 0.0)
        if self.sweep:
            unsure += 0.25**in_sweep
        maps = moves, in_sweep, in_motion, residual + self._guess * unsure
        return Seen(solid, *(values.reshape(solid.shape) for values in maps))

    def _in_motion(
        self, now: Float[np.ndarray, "n 3"], time: float | None
    ) -> list[tuple[Witness, Float[np.ndarray, "n 3"]]]:
        """Each moving camera's witness nearest in time, and where points are then."""
        if time is None:
            return []
        at: float = time
        nearest = [min(clip, key=lambda w: abs((w.time or 0.0) - at)) for clip in self.fixed.values()]
        return [(w, moved(self.model, now, time, w.time)) for w in nearest]


def _stride(opacity: Float[np.ndarray, "h w"]) -> int:
    """Every which pixel in each direction is asked about."""
    return max(LEAST_STRIDE, int(np.ceil(np.sqrt(opacity.size / MOST_POINTS))))


def every_nth(camera: Camera, n: int) -> Camera:
    """A camera whose pixels are every n-th one of another camera's, from number n // 2 on, in both directions."""
    K = camera.K.copy()
    K[:2] /= n
    K[:2, 2] += 0.5 - (n // 2 + 0.5) / n
    return replace(camera, width=camera.width // n, height=camera.height // n, K=K)


def witness_camera(frame: PosedFrame, image_scale: float) -> tuple[Camera, int]:
    """The camera of a witness, and every which pixel of the training picture it has."""
    camera = frame.camera.scaled(image_scale)
    n = max(1, min(EVERY, max(camera.width, camera.height) // FEWEST_PX))
    return every_nth(camera, n), n


def _witness(scene: Scene, model: DynamicModel, frame: PosedFrame) -> Witness:
    camera, n = witness_camera(frame, scene.image_scale)
    picture, depth, opacity = render_layers(model, camera, frame.time)
    whole = load_image(frame, scene.image_scale, scene.background)
    true = whole[n // 2 :: n, n // 2 :: n][: camera.height, : camera.width].astype(np.float32) / 255
    surface = np.where(opacity > SOLID, depth / np.maximum(opacity, SOLID), np.inf)
    residual = ((picture - true) ** 2).mean(-1)
    return Witness(
        frame.time, camera, 1 / (n * camera.K[0, 0]), surface, residual, float(true.var(axis=(0, 1)).mean())
    )


def _sightings(
    asked: Sequence[tuple[Witness, Float[np.ndarray, "n 3"]]], n: int
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """How many witnesses see each point, and the mean of their residuals there; each has the points at its own time."""
    count, residual = np.zeros(n, int), np.zeros(n)
    for witness, points in asked:
        height, width = witness.depth.shape
        pixel = np.nan_to_num(witness.camera.project(points), nan=-1.0)
        inside = np.flatnonzero(((pixel >= 0) & (pixel < [width, height])).all(-1))
        u, v = pixel[inside].astype(int).T
        distance = np.linalg.norm(points[inside] - witness.camera.centre, axis=1)
        free = distance <= (1 + SAME_SURFACE) * witness.depth[v, u]
        count[inside[free]] += 1
        residual[inside[free]] += witness.residual[v[free], u[free]]
    return count, residual / np.maximum(count, 1)
