"""What makes a pixel of a rendered picture wrong, as squared errors that are later weighed against each other.

Each cause is a squared error of the full range, or a share that a fitted squared error goes with:

    floor    any pixel that shows a surface
    place    the surface point is known to within d pixels only: (d |grad I|)^2
    cycle    backward and then forward motion lead c pixels away: (c |grad I|)^2
    sweep    how badly the sweep's pictures are explained at that point
    motion   how badly the moving cameras' pictures nearest in time are explained at that point
    behind   what is seen through the box
    edges    edges of it: |grad I|^2
    mixed    a surface and what is behind it in one pixel

d is error propagation (Hartley & Zisserman, 2nd ed., 5.1): lines of sight true to a pixel, the sweep's to the place at
rest and the moving cameras' to the motion at that time, give a covariance in space, and that a variance in the picture.
A part that only one camera sees is held along that line of sight by nothing: there it may be anywhere within what
things nearby move. |grad I| is that of the rendered picture, and the mean texture of the true ones, because where
little is known a model shows little detail.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.ndimage import gaussian_filter

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame
from devrf.reconstruct.evidence import Evidence, Places, Sightings
from devrf.reconstruct.metrics import MOVING_REACH

CAUSES = ("floor", "place", "cycle", "sweep", "motion", "behind", "edges", "mixed")
DISPLACED = [CAUSES.index("place"), CAUSES.index("cycle")]
ANYWHERE = 0.1  # of the distance: how far off the surface of a point may be that no sweep picture shows
STILL = 1e-5  # of the distance: a motion below this is none
FAINT = 1e-3  # opacity below which there is no surface to speak of
LEAST_STRIDE = 2  # pixels: what is known of neighbours hardly differs, and a quarter of them costs a quarter
MOST_POINTS = 60_000  # of a picture: of larger ones every n-th pixel in each direction is asked

Layers = tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]
"""RGB, depth (weighted distance) and opacity of a rendered picture."""


@dataclass(frozen=True)
class Ground:
    """What holds for all pictures.

    Attributes:
        texture: Mean squared slope of the true training pictures, per pixel of theirs.
        focal_px: Their focal length.
        unrelated: Mean squared difference of two pixels that have nothing to do with each other.
        sweep, motion: Mean squared difference of training pictures, for points that nobody sees.
    """

    texture: float
    focal_px: float
    unrelated: float
    sweep: float
    motion: float


@dataclass(frozen=True)
class Surface:
    """The surface that every n-th pixel of a picture shows.

    Attributes:
        rows, columns: Which pixels.
        opacity: Of them.
        rays_d, distance: Their directions, and how far away it is.
        places: Where it is and where it rests.
        rest, motion: Who sees it; no motion at rest.
    """

    rows: np.ndarray
    columns: np.ndarray
    opacity: Float64[np.ndarray, "rows columns"]
    rays_d: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    places: Places
    rest: Sightings
    motion: Sightings | None

    @property
    def moved(self) -> Float[np.ndarray, " n"]:
        """How far each point is from where it rests."""
        return np.linalg.norm(self.places.now - self.places.at_rest, axis=1)


def surface_of(
    evidence: Evidence, camera: Camera, time: float | None, layers: Layers, besides: PosedFrame | None = None
) -> Surface:
    """Look up what a rendered picture shows.

    Args:
        evidence: The witnesses.
        camera, time: Of the picture, in the box frame; None: the scene at rest.
        layers: The picture.
        besides: The training picture that it is, if it is one: its own differences are left out.
    """
    _, depth, opacity = layers
    stride = max(LEAST_STRIDE, int(np.ceil(np.sqrt(opacity.size / MOST_POINTS))))
    rows, columns = (np.minimum(np.arange(0, n, stride) + stride // 2, n - 1) for n in opacity.shape)
    solid = opacity[np.ix_(rows, columns)].astype(np.float64)
    seen = depth[np.ix_(rows, columns)] / np.maximum(solid, FAINT)
    distance = np.where(solid > FAINT, seen, 1.0).reshape(-1)  # where there is nothing any distance does
    rays_d = camera.directions(np.stack(np.meshgrid(columns + 0.5, rows + 0.5), axis=-1).reshape(-1, 2))
    places = evidence.places(camera.centre + distance[:, None] * rays_d, time)
    motion = evidence.of_motion(places, time, besides) if time is not None and evidence.fixed else None
    return Surface(rows, columns, solid, rays_d, distance, places, evidence.of_rest(places, besides), motion)


def causes(
    surface: Surface, camera: Camera, layers: Layers, ground: Ground
) -> Float64[np.ndarray, "h w causes"]:
    """All causes, in the order of `CAUSES`, for every pixel."""
    shape = surface.opacity.shape
    reach_px = MOVING_REACH * camera.width * shape[1] / layers[2].shape[1]
    variance = _variance(surface, reach_px)
    per_unit = (camera.K[0, 0] / surface.distance) ** 2
    across = np.eye(3) - surface.rays_d[:, :, None] * surface.rays_d[:, None, :]
    place = 0.5 * per_unit * np.einsum("nij,nji->n", across, variance)
    cycle = per_unit * surface.places.cycle**2
    sweep = np.where(np.isnan(surface.rest.residual), ground.sweep, surface.rest.residual)
    motion = np.zeros_like(sweep)
    if surface.motion is not None:
        motion = np.where(np.isnan(surface.motion.residual), ground.motion, surface.motion.residual)
    place, cycle, sweep, motion = (x.reshape(shape) for x in (place, cycle, sweep, motion))
    place, cycle, sweep, motion = (_on_all(x, layers[2].shape) for x in (place, cycle, sweep, motion))
    own = slope(layers[0])
    detail = own + ground.texture * (ground.focal_px / camera.K[0, 0]) ** 2
    a = layers[2].astype(np.float64)
    b = 1 - a
    parts = (a, a * place * detail, a * cycle * detail, a * sweep, a * motion, b, b * own, a * b)
    return np.stack(parts, axis=-1)


def most_displaced(layers: Layers, ground: Ground) -> Float64[np.ndarray, "h w"]:
    """What displaced surfaces can be wrong by at most: as two pixels that have nothing to do with each other."""
    return ground.unrelated * np.maximum(layers[2].astype(np.float64), FAINT)


def slope(picture: Float[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w"]:
    """Squared slope per pixel, mean over channels, of a pixel's neighbourhood."""
    down, right = np.gradient(picture.astype(np.float64), axis=(0, 1))
    return gaussian_filter((down**2 + right**2).mean(-1), 1.0)


def _variance(surface: Surface, reach_px: float) -> Float64[np.ndarray, "n 3 3"]:
    """Covariance of the surface's points in space, if a line of sight is true to a pixel."""
    distance, eye = surface.distance, np.eye(3)
    out = np.linalg.inv(surface.rest.information + eye / (ANYWHERE * distance)[:, None, None] ** 2)
    if surface.motion is not None:
        solid = surface.opacity
        squares = gaussian_filter(solid * surface.moved.reshape(solid.shape) ** 2, reach_px)
        nearby = (squares / np.maximum(gaussian_filter(solid, reach_px), FAINT)).reshape(-1)
        prior = np.maximum(nearby, (STILL * distance) ** 2)
        out += np.linalg.inv(surface.motion.information + eye / prior[:, None, None])
    return out


def _on_all(values: Float[np.ndarray, "rows columns"], shape: tuple[int, ...]) -> Float[np.ndarray, "h w"]:
    """Values of every n-th pixel on all pixels."""
    stride = -(-shape[0] // values.shape[0])
    return values.repeat(stride, axis=0).repeat(stride, axis=1)[: shape[0], : shape[1]]
