"""Two coloured walls at right angles, as cameras of known colours show them: what tests of colour look at."""

from functools import cache

import cv2
import numpy as np
from tests.calibration.conftest import DOWN

from devrf.calibration.colour.surface import View
from devrf.calibration.sweep.static_poses import SweepModel
from devrf.capture.camera import Camera
from devrf.capture.colour.srgb import LEVEL_OF_LINEAR
from devrf.capture.view_axes import look_at

SIZE = (480, 360)
FOCAL = 420.0
SIDE = 900  # pixels of a wall of 3 m: as fine as the pictures
WALLS = (  # corners, metres; z points down
    np.array([[0, 0, 0], [3, 0, 0], [3, 0, -3], [0, 0, -3.0]]),
    np.array([[0, 0, 0], [0, 3, 0], [0, 3, -3], [0, 0, -3.0]]),
)
EQUAL = np.eye(3)


def camera(angle: float, height: float = -1.5, size: tuple[int, int] = SIZE) -> Camera:
    """On an arc before the corner; angles from 0.15 to 1.4 see both walls."""
    centre, target = np.array([4.2 * np.cos(angle), 4.2 * np.sin(angle), height]), np.array([0.5, 0.5, -1.5])
    f = FOCAL * size[0] / SIZE[0]
    K = np.array([[f, 0, size[0] / 2], [0, f, size[1] / 2], [0, 0, 1]])
    return Camera(*size, K, look_at(centre, target, DOWN))


def show(
    camera: Camera, colours: np.ndarray = EQUAL, noise: float = 0.01, seed: int = 0, brightest: float = 0.45
) -> View:
    """What a camera shows of the room.

    Args:
        camera: Where it stands.
        colours: Its linear light = colours · the room's [3, 3].
        noise: Standard deviation of its sRGB values, of full scale.
        seed: Of the noise.
        brightest: The room's brightest linear light.
    """
    rng = np.random.default_rng(seed)
    light = np.full((camera.height, camera.width, 3), 0.1, np.float32)
    for wall, corners in zip(_walls(), WALLS, strict=True):
        source = np.array([[0, 0], [SIDE - 1, 0], [SIDE - 1, SIDE - 1], [0, SIDE - 1]], np.float32)
        H = cv2.getPerspectiveTransform(source, (camera.project(corners) - 0.5).astype(np.float32))
        size = (camera.width, camera.height)
        inside = cv2.warpPerspective(np.full((SIDE, SIDE), 255, np.uint8), H, size) > 127
        light[inside] = cv2.warpPerspective(wall, H, size)[inside]
    return View(camera, developed(brightest * light @ colours.T, noise, rng))


def developed(light: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Linear light as a camera stores it: sRGB in 8 bits, with noise."""
    levels = LEVEL_OF_LINEAR[(65535 * np.clip(light, 0, 1)).astype(int)]
    return np.clip(levels + 255 * noise * rng.standard_normal(light.shape), 0, 255).round().astype(np.uint8)


def sweep(count: int = 9, points: int = 500, seed: int = 0) -> SweepModel:
    """A sweep past the room: points on the walls, seen in every picture to 0.3 px."""
    rng = np.random.default_rng(seed)
    cameras = tuple(camera(angle, -1.5 + 0.3 * np.sin(5 * angle)) for angle in np.linspace(0.15, 1.4, count))
    along, up = rng.uniform(0.1, 2.9, (2, points))
    first = rng.random(points) < 0.5
    xyz = np.column_stack([np.where(first, along, 0), np.where(first, 0, along), -up])
    seen = [(p, c, xy) for c, view in enumerate(cameras) for p, xy in enumerate(view.project(xyz))]
    seen = [(p, c, xy) for p, c, xy in seen if (xy > 0).all() and (xy < SIZE).all()]
    obs_xy = np.array([xy for *_, xy in seen]) + 0.3 * rng.standard_normal((len(seen), 2))
    return SweepModel(
        names=tuple(f"static/{n:06d}.png" for n in range(count)),
        cameras=cameras,
        xyz=xyz,
        rgb=np.zeros((points, 3), np.uint8),
        error_px=np.full(points, 0.3),
        obs_point=np.array([p for p, *_ in seen]),
        obs_image=np.array([c for _, c, _ in seen]),
        obs_xy=obs_xy,
        obs_descriptor=np.zeros((len(seen), 128), np.uint8),
        report={},
    )


@cache
def _walls() -> tuple[np.ndarray, np.ndarray]:
    """Discs of all colours and many sizes, linear light in [0, 1]."""
    rng = np.random.default_rng(7)
    walls = []
    for _ in range(2):
        wall = np.full((SIDE, SIDE, 3), 0.3, np.float32)
        for _ in range(1500):
            centre = (int(rng.integers(0, SIDE)), int(rng.integers(0, SIDE)))
            cv2.circle(wall, centre, int(rng.integers(4, 25)), rng.uniform(0.05, 1, 3).tolist(), -1)
        walls.append(cv2.GaussianBlur(wall, (0, 0), 1.5))
    return walls[0], walls[1]
