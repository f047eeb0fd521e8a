"""Views of a board with known truth, as corners without pictures: for tests and `bench calibration`."""

from dataclasses import dataclass

import cv2
import numpy as np

from devrf.calibration.boards.spec import BoardSpec, BoardView
from devrf.capture.camera import Camera, LensModel

SPEC = BoardSpec("charuco", (8, 6), 0.06, 0.045)
SIZE = (1280, 720)
FOCAL = 1000.0
CENTRE = (645.0, 352.0)
LENS = (-0.1, 0.03, 0.0, 0.0, 0.0)
TILT_DEG = (5.0, 45.0)


def camera(
    focal: float = FOCAL,
    lens: tuple[float, ...] = LENS,
    model: LensModel = "OPENCV",
    size: tuple[int, int] = SIZE,
) -> Camera:
    """A camera at the origin."""
    K = np.array([[focal, 0, CENTRE[0]], [0, focal, CENTRE[1]], [0, 0, 1.0]])
    return Camera(*size, K, np.eye(3, 4), np.array(lens), model)


@dataclass(frozen=True)
class Held:
    """How a board is held before a camera.

    Attributes:
        place, share: Ranges of its middle as a share of the picture, and of its width as a share of the picture's.
        bow_m: How far its middle stands out along x.
    """

    place: tuple[float, float] = (0.15, 0.85)
    share: tuple[float, float] = (0.35, 0.75)
    bow_m: float = 0.0


EVERYWHERE = Held()


def board_views(
    count: int,
    noise_px: float,
    seed: int = 0,
    lens: Camera | None = None,
    held: Held = EVERYWHERE,
    common_px: float = 0.0,
) -> list[BoardView]:
    """Boards tilted in all directions at places all over the picture.

    Args:
        count: How many, each with 12 corners or more.
        noise_px: Of every corner, on its own.
        seed: Of all that is drawn.
        lens: The camera; `camera()` where None.
        held: How.
        common_px: Smooth error that the corners of a view share, as of a board that is not where its pose says.
    """
    cam, rng, views = lens or camera(), np.random.default_rng(seed), []
    corners = SPEC.corners
    middle, half = corners.mean(0), np.ptp(corners, axis=0)[:2] / 2
    unit = (corners[:, :2] - middle[:2]) / half
    bowed = corners + np.column_stack([np.zeros((len(corners), 2)), held.bow_m * (1 - unit[:, 0] ** 2)])
    while len(views) < count:
        about = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        R = cv2.Rodrigues(np.radians(rng.uniform(*TILT_DEG)) * axis)[0]
        R = R @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-0.3, 0.3)]))[0]
        distance = cam.K[0, 0] * SPEC.squares[0] * SPEC.square_m / (rng.uniform(*held.share) * cam.width)
        ray = cam.directions(rng.uniform(*held.place, 2) * (cam.width, cam.height))
        centre = ray * distance / (ray[2] if cam.model == "OPENCV" else 1.0)
        pose = np.column_stack([R, centre - R @ middle])
        xy = Camera(cam.width, cam.height, cam.K, pose, cam.distortion, cam.model).project(bowed)
        seen = np.isfinite(xy).all(1) & (xy > 2).all(1) & (xy < np.array([cam.width, cam.height]) - 2).all(1)
        if seen.sum() < 12:
            continue
        noise = noise_px * rng.standard_normal(xy.shape)
        smooth = np.column_stack([np.ones(len(unit)), unit, unit**2])
        noise += common_px * smooth @ rng.standard_normal((5, 2))
        views.append(BoardView(len(views), np.flatnonzero(seen), (xy + noise)[seen]))
    return views
