"""How sure what a model shows is: how many cameras see the surface, from all directions of the sweep.

A *witness* is every fourth pixel of a training picture in both directions, rendered anew: its depth says what it sees.
Sweep pictures witness the scene at rest, pictures of the moving cameras the motion. A point at time t is taken to its
place at rest by the backward motion and from there to the witness' own time by the forward motion. The pictures
themselves are not read.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.capture.system.spread import spread
from devrf.reconstruct.geometry.field import moved
from devrf.reconstruct.rendering.model import SOLID, DynamicModel, render_layers
from devrf.reconstruct.sampling.pictures import clips, training

EVERY = 4  # pixel of a training picture, in both directions, is what its witness has
MOST_OF_SWEEP = 10  # witnesses at rest, spread over the sweep
MOST_OF_MOTION = 12  # witnesses in motion, over all cameras
LEAST_PER_CAMERA = 3  # the first, which is mostly at rest, one in the middle and the last
FEWEST_PX = 32  # of its longer side: with less it cannot tell what hides what
SAME_SURFACE = 0.03  # of the distance: a point farther behind what a witness sees is hidden from it
STRIDE = 2  # pixels: what is known of neighbours hardly differs, and a quarter of them costs a quarter
DIRECTIONS = 4  # of the sweep, from which is asked
TIMES = (1 / 3, 2 / 3)  # of the clip, where something moves
LEAST_MOVING = 0.02  # of the points, to be the subject: the box is made around what moves, less is stray


@dataclass(frozen=True)
class Witness:
    """A training picture, small.

    Attributes:
        time: Of it; None: at rest.
        camera: At the small size, in the box frame.
        pixel_rad: Angle of a pixel of the training size.
        depth: Distance of the surface seen; infinite where it sees through the box.
    """

    time: float | None
    camera: Camera
    pixel_rad: float
    depth: Float[np.ndarray, "h w"]


@dataclass(frozen=True)
class VisibilityMaps:
    """Who sees what every second pixel of a picture shows, as maps of these pixels.

    Attributes:
        opacity: Of the pixels.
        moves: Whether the point is a pixel of the training pictures or more away from where it rests.
        in_sweep: Sweep witnesses that see it.
        in_motion: Moving cameras that see it at that time.
    """

    opacity: Float64[np.ndarray, "rows columns"]
    moves: Bool[np.ndarray, "rows columns"]
    in_sweep: Int[np.ndarray, "rows columns"]
    in_motion: Int[np.ndarray, "rows columns"]


def subject_seen(scene: Scene, model: DynamicModel) -> dict[str, Any]:
    """Shares of the subject's surface by how many cameras see it.

    The model is rendered, small, from a few places of the sweep at a few times, as nobody may have filmed it. The
    subject is what moves, or all that is solid in the box where nothing does.

    Args:
        scene: Only cameras of its training pictures are asked; in any frame.
        model: As it is rendered.
    Returns:
        `moves`: whether only what moves was taken; `unseen_share`: what no moving camera sees at that time (None where
        not only what moves was taken); `seen_by`: by number of `cameras` that see it (moving ones, or witnesses of the
        sweep), its `share`; empty where nothing solid is seen.
    """
    scene = scene.in_box_frame()
    witnesses = Witnesses(scene, model)
    times = TIMES if witnesses.fixed else (None,)
    parts = []
    for frame in spread(training(scene.static), DIRECTIONS):
        camera, _ = witness_camera(frame, scene.image_scale)
        for time in times:
            seen = witnesses.seen(camera, time)
            solid = seen.opacity > SOLID
            parts.append([column[solid] for column in (seen.in_sweep, seen.in_motion, seen.moves)])
    in_sweep, in_motion, moving = (np.concatenate(column) for column in zip(*parts, strict=True))
    moves = len(moving) > 0 and bool(moving.mean() >= LEAST_MOVING)
    cameras = in_motion[moving] if moves else in_sweep
    return {
        "moves": moves,
        "unseen_share": float((cameras == 0).mean()) if moves else None,
        "seen_by": [{"cameras": int(n), "share": float((cameras == n).mean())} for n in np.unique(cameras)],
    }


class Witnesses:
    """Training pictures that say what cameras see of a model.

    Args:
        scene: In the box frame.
        model: As it is rendered.
    Attributes:
        sweep: Witnesses of the scene at rest.
        fixed: Witnesses of the motion, by camera.
    """

    def __init__(self, scene: Scene, model: DynamicModel) -> None:
        self.model = model
        self.sweep = [_witness(scene, model, f) for f in spread(training(scene.static), MOST_OF_SWEEP)]
        self.fixed: dict[str, list[Witness]] = {}
        moving = clips(scene) if model.motion is not None else {}
        for name, clip in moving.items():
            chosen = spread(clip, max(LEAST_PER_CAMERA, MOST_OF_MOTION // len(moving)))
            self.fixed[name] = [_witness(scene, model, f) for f in chosen]
        witnesses = self.sweep + [w for clip in self.fixed.values() for w in clip]
        self._pixel_rad = float(np.median([w.pixel_rad for w in witnesses]))

    def seen(self, camera: Camera, time: float | None) -> VisibilityMaps:
        """Who sees what a camera in the box frame shows at a time in [0, 1]; None: the scene at rest."""
        _, depth, opacity = render_layers(self.model, camera, time)
        rows, columns = (np.minimum(np.arange(0, n, STRIDE) + STRIDE // 2, n - 1) for n in opacity.shape)
        solid = opacity[np.ix_(rows, columns)].astype(np.float64)
        away = depth[np.ix_(rows, columns)].reshape(-1, 1) / np.maximum(solid.reshape(-1, 1), SOLID)
        pixels = np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1).reshape(-1, 2)
        now = camera.centre + away * camera.directions(pixels)
        rest = moved(self.model, now, time, None)
        moves = np.linalg.norm(now - rest, axis=1) > self._pixel_rad * away[:, 0]
        in_sweep = _sightings([(w, rest) for w in self.sweep], len(now))
        in_motion = _sightings(self._in_motion(now, time), len(now))
        return VisibilityMaps(
            solid, *(values.reshape(solid.shape) for values in (moves, in_sweep, in_motion))
        )

    def _in_motion(
        self, now: Float[np.ndarray, "n 3"], time: float | None
    ) -> list[tuple[Witness, Float[np.ndarray, "n 3"]]]:
        """Each moving camera's witness nearest in time, and where points are then."""
        if time is None:
            return []
        at: float = time
        nearest = [min(clip, key=lambda w: abs((w.time or 0.0) - at)) for clip in self.fixed.values()]
        return [(w, moved(self.model, now, time, w.time)) for w in nearest]


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
    _, depth, opacity = render_layers(model, camera, frame.time)
    surface = np.where(opacity > SOLID, depth / np.maximum(opacity, SOLID), np.inf)
    return Witness(frame.time, camera, 1 / (n * camera.K[0, 0]), surface)


def _sightings(asked: Sequence[tuple[Witness, Float[np.ndarray, "n 3"]]], n: int) -> Int[np.ndarray, " n"]:
    """How many witnesses see each point; each has the points at its own time."""
    count = np.zeros(n, int)
    for witness, points in asked:
        height, width = witness.depth.shape
        pixel = np.nan_to_num(witness.camera.project(points), nan=-1.0)
        inside = np.flatnonzero(((pixel >= 0) & (pixel < [width, height])).all(-1))
        u, v = pixel[inside].astype(int).T
        distance = np.linalg.norm(points[inside] - witness.camera.centre, axis=1)
        count[inside[distance <= (1 + SAME_SURFACE) * witness.depth[v, u]]] += 1
    return count
