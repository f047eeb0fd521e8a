"""A rig of which everything is known: cameras around a volume, a board carried through it, corners with noise.

For benchmarks and tests: the views go into the same entry points as those of a real capture.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from devrf.calibration.boards.find import BoardSpec, BoardView
from devrf.calibration.intrinsics import Intrinsics, from_vector
from devrf.calibration.rigs.board_views import TimedView
from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at

SPEC = BoardSpec("charuco", (8, 6), 0.06, 0.045, inverted=False, legacy=False)
MIN_CORNERS = 6
SIZE, FOCAL_PX, DISTORTION = (1280, 720), 900.0, (-0.1, 0.02, 0.0, 0.0, 0.0)  # k1, k2, p1, p2, k3
DISTANCE_M = 2.5  # of the cameras to the middle of the volume
FPS, NOISE_PX = 3.0, 0.3


@dataclass(frozen=True)
class SyntheticRig:
    """What to make.

    Attributes:
        cameras: How many; spread_deg: angle between the outermost.
        depth_m: The board moves this far towards the cameras and away from them; width_m: and to the sides.
        duration_s: Of the clips.
    """

    cameras: int = 4
    spread_deg: float = 90.0
    depth_m: float = 1.2
    width_m: float = 1.1
    duration_s: float = 40.0


def synthetic_cameras(rig: SyntheticRig, rng: np.random.Generator) -> dict[str, Camera]:
    """Cameras that look at the middle of the volume, the first one's frame is the world."""
    out: dict[str, Camera] = {}
    half = np.radians(rig.spread_deg) / 2
    for n, azimuth in enumerate(np.linspace(-half, half, rig.cameras)):
        elevation = 0.15 * (-1) ** n + 0.05 * rng.standard_normal()
        centre = DISTANCE_M * np.array(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), -np.cos(azimuth) * np.cos(elevation)]
        )
        focal = FOCAL_PX * (1 + 0.02 * rng.standard_normal())
        middle = np.array(SIZE) / 2 + 0.005 * SIZE[0] * rng.standard_normal(2)
        k = from_vector(*SIZE, np.array([focal, focal, *middle, *DISTORTION]))
        out[f"cam{n}"] = k.at(look_at(centre, np.zeros(3), (0.0, -1.0, 0.0)))
    first = np.linalg.inv(next(iter(out.values())).world_from_cam)
    return {name: camera.moved(first) for name, camera in out.items()}


def synthetic_views(
    rig: SyntheticRig,
    cameras: dict[str, Camera],
    rng: np.random.Generator,
    delay_s: dict[str, float] | None = None,
) -> dict[str, list[TimedView]]:
    """Views of a board that faces the cameras, tilts and goes through the volume.

    Args:
        delay_s: Pictures of a camera show what was `delay_s` after the time that is written on them.
    """
    first = next(iter(cameras.values()))
    middle = first.centre + DISTANCE_M * first.cam_from_world[2, :3]
    towards = np.mean([c.centre for c in cameras.values()], axis=0) - middle
    towards /= np.linalg.norm(towards)
    corners = SPEC.corners - SPEC.corners.mean(0)
    phase = rng.uniform(0, 2 * np.pi, 6)
    views: dict[str, list[TimedView]] = {name: [] for name in cameras}
    for n in range(int(rig.duration_s * FPS)):
        for name, camera in cameras.items():
            place = _board_at(n / FPS + (delay_s or {}).get(name, 0.0), phase, towards, rig)
            xy = camera.project(corners @ place[:, :3].T + place[:, 3] + middle)
            xy = xy + NOISE_PX * rng.standard_normal(xy.shape)
            inside = ((xy > 0) & (xy < np.array(SIZE))).all(1)
            faces = (camera.centre - middle - place[:, 3]) @ place[:, 2] < 0
            if faces and inside.sum() >= MIN_CORNERS:
                view = BoardView(n, np.flatnonzero(inside), xy[inside])
                views[name].append(TimedView(view, n / FPS))
    return views


def claimed(
    camera: Camera, rng: np.random.Generator, focal_share: float, focal_std: float, middle_std_px: float
) -> Intrinsics:
    """A calibration whose focal length is off by `focal_share`, up or down, and that claims `focal_std` (relative).

    The principal point is off at random by what its standard deviation says; 0 means known and held.
    """
    vector = Intrinsics(camera.width, camera.height, camera.K, camera.distortion).vector
    vector[:2] *= 1 + focal_share * rng.choice([-1, 1])
    vector[2:4] += middle_std_px * rng.standard_normal(2)
    focal = focal_std * vector[0]
    std = np.array([focal, focal, middle_std_px, middle_std_px, 0.02, 0.02, 0.0, 0.0, 0.0])
    return from_vector(camera.width, camera.height, vector, std)


def _board_at(
    t: float, phase: Float[np.ndarray, "6"], towards: Float[np.ndarray, "3"], rig: SyntheticRig
) -> Float[np.ndarray, "3 4"]:
    """world_from_board about the middle of the volume; smooth, through the whole volume in half a minute."""
    side = np.cross([0.0, 1.0, 0.0], towards)
    side /= np.linalg.norm(side)
    wave = np.sin(np.array([0.31, 0.47, 0.67, 0.83, 0.59, 0.43]) * t + phase)
    shift = rig.depth_m * wave[0] * towards + rig.width_m * (
        wave[1] * side + 0.5 * wave[2] * np.cross(towards, side)
    )
    facing = np.stack([-side, np.cross(towards, side), -towards], axis=1)
    facing[:, 0] = np.cross(facing[:, 1], facing[:, 2])
    turn = cv2.Rodrigues(np.array([0.6 * wave[3], 0.6 * wave[4], 0.5 * wave[5]]))[0]
    return np.column_stack([facing @ turn, shift])
