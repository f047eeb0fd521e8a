"""A small scene whose model is known: a patterned ball that moves along a straight line, before white."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from tests.make.models import straight
from tests.make.scenes import scene_of

from devrf.capture import view_axes
from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.training.train_canonical import train_canonical

RADIUS = 0.45
TRAVEL = np.array([0.3, 0.0, 0.15])  # of the centre, from time 0 to time 1, box units
WIDTH, HEIGHT, FOCAL = 48, 40, 60.0
ROUND = np.eye(3)  # of the ball, which is not stretched

REST = CanonicalOptions(
    resolution=40, iterations=120, rays=1024, samples=8192, channels=6, mlp_width=24,
    scale_at=(0.25, 0.5), opacity=0.1, alpha_threshold=1e-3, weight_threshold=1e-3, lr_grid=0.06, learning_rate=5.0,
    occupancy_every=20, hull_resolution=40,
)  # fmt: skip


@dataclass(frozen=True)
class Ball:
    """The scene and its truth."""

    scene: Scene
    travel: np.ndarray
    radius: float


def ball_picture(camera: Camera, centre: np.ndarray, stretch: np.ndarray = ROUND) -> np.ndarray:
    """RGBA picture [H, W, 4] of the ball, stretched about its centre, four rays per pixel, traced in closed form."""
    offsets = (np.arange(camera.width * 2) + 0.5) / 2, (np.arange(camera.height * 2) + 0.5) / 2
    back = np.linalg.inv(stretch)
    d = camera.directions(np.stack(np.meshgrid(*offsets), axis=-1)) @ back.T
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    o = back @ (camera.centre - centre)
    b = d @ o
    root = b**2 - (o @ o - RADIUS**2)
    hit = root > 0
    normal = (o + (-b - np.sqrt(np.where(hit, root, 0)))[..., None] * d) / RADIUS
    rgba = np.dstack([0.5 + 0.45 * np.sin(4 * normal + [0, 1, 2]), np.ones(hit.shape)]) * hit[..., None]
    small = cv2.resize(rgba, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    small[..., :3] /= np.maximum(small[..., 3:], 1e-6)
    return (small * 255).round().clip(0, 255).astype(np.uint8)


def ball_clips(
    ball: Ball, folder: Path, times: int, travel: np.ndarray, stretch: np.ndarray = ROUND
) -> Scene:
    """The ball on its way, seen by all cameras of its scene at so many times; all of its way takes a second.

    By its end it is stretched.
    """
    frames = []
    for name, camera in {f.camera_name: f.camera for f in ball.scene.dynamic}.items():
        for n in range(times):
            path, time = folder / f"{name}_{n}.png", n / (times - 1)
            picture = ball_picture(camera, time * travel, np.eye(3) + time * (stretch - np.eye(3)))
            cv2.imwrite(str(path), picture[..., [2, 1, 0, 3]])
            frames.append(PosedFrame(path, camera, name, n, time, time, "train"))
    return replace(ball.scene, dynamic=tuple(frames))


def true_motion(scene: Scene, travel: np.ndarray) -> MotionField:
    """How the ball moves, exactly, everywhere in the box."""
    return straight(torch.tensor(scene.aabb).float(), travel)


def look_at(
    eye: np.ndarray, width: int = WIDTH, height: int = HEIGHT, target: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> Camera:
    """A camera that looks at a place; +z is up."""
    K = np.array([[FOCAL, 0, width / 2 + 0.7], [0, FOCAL * 1.02, height / 2 - 0.4], [0, 0, 1]])
    return Camera(width, height, K, view_axes.look_at(eye, np.array(target)))


def held_rays(cameras: list[Camera], pictures: list[np.ndarray], times: list[float] | None = None) -> RaySet:
    """Rays of pictures in memory, without entries of a scene."""
    rays = RaySet.__new__(RaySet)
    rays._fill((), cameras, pictures, "cpu")
    if times is not None:
        rays.times = torch.tensor(times, dtype=torch.float32)
    return rays


def around(n: int, phase: float, height: float) -> list[np.ndarray]:
    angles = phase + 2 * np.pi * np.arange(n) / n
    return [2.6 * np.array([np.cos(a), np.sin(a), height * np.cos(3 * a)]) for a in angles]


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Ball:
    """24 pictures of the ball at rest (two held out), four cameras with five times each, one of them for tests."""
    folder: Path = tmp_path_factory.mktemp("ball")

    def frame(name: str, index: int, eye: np.ndarray, time: float | None, split: str) -> PosedFrame:
        path, camera = folder / f"{name}_{index}.png", look_at(eye)
        picture = ball_picture(camera, (time or 0.0) * TRAVEL)
        cv2.imwrite(str(path), picture[..., [2, 1, 0, 3]])
        return PosedFrame(path, camera, name, index, time, time, "test" if split == "test" else "train")

    static = [
        frame("static", n, eye, None, "test" if n % 12 == 5 else "train")
        for n, eye in enumerate(around(12, 0.0, 0.3) + around(12, 0.2, 0.8))
    ]
    dynamic = [
        frame(f"cam{c}", n, eye, n / 4, "test" if c == 3 else "train")
        for c, eye in enumerate(around(4, 0.5, 0.5))
        for n in range(5)
    ]
    scene = scene_of(static, dynamic, near=0.5, far=6.0, background="white")
    return Ball(scene, TRAVEL, RADIUS)


@pytest.fixture(scope="session")
def rest(ball: Ball) -> RestModel:
    """The ball at rest, learned quickly; nobody changes it."""
    return train_canonical(ball.scene, REST)
