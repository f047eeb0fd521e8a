"""Where the simulated cameras stand, and what their clocks say.

Fixed cameras stand on a sphere around the clapping hands, so that sound reaches them at nearly the same
time. True time = offset_s + (1 + 1e-6 drift_ppm) * file time, on cam0's clock.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.scenes.catalogue import CENTRE
from devrf.lab.simulate.scenes.session_options import SessionOptions

CLAPPER = np.array([0.05, 0.0, 1.25])
JITTER_M = 0.03  # largest deviation of a camera from its even place
FOV_DEG = 60.0  # width of the fixed cameras' view, before jitter of 1.5 %; the sweep's is a tenth wider
BOARD_SQUARES, BOARD_SQUARE_M = (8, 6), 0.06  # columns and rows; the markers are three quarters of a square
BOARD_AZIMUTH_DEG = 180.0  # behind the object, seen from the fixed cameras
BOARD_ARC = 1 / 6  # of the sweep's pictures are taken before the board
VIDEO_TICKS_HZ = 90_000


@dataclass(frozen=True)
class FixedCamera:
    """One free-running camera.

    Attributes:
        name: cam0, cam1, ..., witness.
        camera: Lens and pose.
        offset_s, drift_ppm: Its clock.
        gain: Exposure relative to the sweep's, linear.
        file_times_s: Presentation times of its frames [N], multiples of 1/90000 s, the first is 0.
    """

    name: str
    camera: Camera
    offset_s: float
    drift_ppm: float
    gain: float
    file_times_s: Float[np.ndarray, " n"]

    def true_time(self, file_time_s: float) -> float:
        """Time on cam0's clock."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * file_time_s


def fixed_cameras(
    rng: np.random.Generator, count: int, size: tuple[int, int], options: SessionOptions
) -> list[FixedCamera]:
    """`count` cameras spread evenly around the object, and last the witness, which `fan_deg` does not turn."""
    half = options.spread_deg / 2 if count > 1 else 0.0
    fan = options.fan_deg + np.linspace(-half, half, count)
    azimuths = [*fan, 0.0 if count % 2 == 0 else half / max(count - 1, 1)]
    cameras = []
    for i, azimuth in enumerate(azimuths):
        name = "witness" if i == count else f"cam{i}"
        elevation = 2.0 if i == count else (-8.0, 12.0)[i % 2]
        distance = options.camera_distance_m + JITTER_M * rng.uniform(-1, 1)
        spread = np.degrees(JITTER_M / options.camera_distance_m) * rng.uniform(-1, 1, 2)
        position = CLAPPER + distance * _direction(azimuth + spread[0], elevation + spread[1])
        target = CENTRE + JITTER_M * rng.uniform(-1, 1, 3)
        lens = _lens(rng, size, FOV_DEG, options.k1)
        camera = replace(
            _upright(lens) if options.portrait and i == count - 1 else lens,
            cam_from_world=look_at(position, target, roll_deg=rng.uniform(-1.5, 1.5)),
        )
        offset_s = 0.0 if i == 0 else options.offset_range_s * rng.uniform(-1, 1)
        drift_ppm = 0.0 if i == 0 else options.drift_range_ppm * rng.uniform(-1, 1)
        cameras.append(
            FixedCamera(
                name=name,
                camera=camera,
                offset_s=round(float(offset_s), 6),
                drift_ppm=round(float(drift_ppm), 3),
                gain=round(float(1 + options.gain_range * rng.uniform(-1, 1)), 4),
                file_times_s=_file_times(rng, options, rate_hz(i, options)),
            )
        )
    return cameras


def sweep_cameras(rng: np.random.Generator, size: tuple[int, int], options: SessionOptions) -> list[Camera]:
    """The moving camera's poses: a low ring, a high ring, then an arc before the board, if there is one."""
    lens = _lens(rng, size, 1.1 * FOV_DEG, options.k1)
    count = options.sweep_frames
    at_board = int(count * BOARD_ARC) if options.board else 0
    low = (count - at_board + 1) // 2
    high = count - at_board - low
    path = [(BOARD_AZIMUTH_DEG + 360 * i / low, 0.95, 1.0) for i in range(low)]
    path += [
        (BOARD_AZIMUTH_DEG + 360 * (i + 0.5) / max(high, 1), 1.6, options.sweep_aim_m) for i in range(high)
    ]
    path += [(BOARD_AZIMUTH_DEG + 80 * (i / max(at_board - 1, 1) - 0.5), 1.2, 0.68) for i in range(at_board)]
    cameras = []
    for azimuth, height, aim in path:
        wobble = rng.uniform(-1, 1, 7)
        radius = options.sweep_radius_m * (1 + 0.03 * wobble[0])
        position = radius * _direction(azimuth + 1.5 * wobble[1], 0.0) + [0, 0, height + 0.05 * wobble[2]]
        target = np.array([0, 0, aim]) + 0.05 * wobble[3:6]
        cameras.append(replace(lens, cam_from_world=look_at(position, target, roll_deg=2 * wobble[6])))
    return cameras


def board_pose() -> Float[np.ndarray, "4 4"]:
    """world_from_board of the board that stands in the room; board axes are OpenCV's: x right, y down."""
    outward = _direction(BOARD_AZIMUTH_DEG, 0.0)
    tilt = np.radians(20.0)  # leans back, so that the high ring sees it too
    z = -np.cos(tilt) * outward - np.sin(tilt) * np.array([0, 0, 1.0])  # into the board
    x = np.cross(np.array([0, 0, -1.0]), z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, y, z], axis=1)
    half = np.array(BOARD_SQUARES) * BOARD_SQUARE_M / 2
    middle = 0.72 * outward + [0, 0, 0.66]
    pose[:3, 3] = middle - half[0] * x - half[1] * y
    return pose


def _lens(rng: np.random.Generator, size: tuple[int, int], fov_deg: float, k1: float) -> Camera:
    width, height = size
    focal = width / 2 / np.tan(np.radians(fov_deg) / 2) * (1 + 0.015 * rng.uniform(-1, 1))
    cx, cy = np.array([width, height]) / 2 + 0.008 * width * rng.uniform(-1, 1, 2)
    K = np.array([[focal, 0, cx], [0, focal, cy], [0, 0, 1.0]])
    distortion = np.array([k1 * (1 + 0.2 * rng.uniform(-1, 1)), 0, 0, 0, 0])
    return Camera(width, height, K, np.eye(3, 4), distortion)


def rate_hz(number: int, options: SessionOptions) -> float:
    """Frame rate of a fixed camera; the witness comes after the others."""
    return options.other_fps if number % 2 and options.other_fps else options.fps


def _upright(camera: Camera) -> Camera:
    """The same lens, the camera turned by a quarter."""
    K = camera.K.copy()
    K[:2, 2] = K[[1, 0], 2]
    return replace(camera, width=camera.height, height=camera.width, K=K)


def _file_times(rng: np.random.Generator, options: SessionOptions, fps: float) -> np.ndarray:
    count = max(2, int(options.duration_s * fps))
    jitter_s = min(options.pts_jitter_ms / 1000, 0.4 / fps)  # frames keep their order
    times = np.arange(count) / fps + jitter_s * rng.uniform(-1, 1, count)
    return np.round((times - times[0]) * VIDEO_TICKS_HZ) / VIDEO_TICKS_HZ


def _direction(azimuth_deg: float, elevation_deg: float) -> np.ndarray:
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
