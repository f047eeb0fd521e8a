"""The first, coarse model: what stands near one camera is learned from the others."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tests.make.scenes import scene_of

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, SparsePoints
from devrf.capture.view_axes import look_at
from devrf.reconstruct.fields.contracted_background import CUBE
from devrf.reconstruct.kernels.background import contract
from devrf.reconstruct.kernels.trilinear import trilinear
from devrf.reconstruct.options import preset
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.training.train_coarse import train_coarse

WIDTH, HEIGHT = 24, 16
K = np.array([[20.0, 0, WIDTH / 2], [0, 20, HEIGHT / 2], [0, 0, 1]])
NEAR = 1.5  # of all cameras, box units
AT = 3.0  # along x, where the one camera stands that looks away from the wall
WALL = AT + 0.3 * NEAR


def _camera(*centre: float, target: tuple[float, float, float]) -> Camera:
    return Camera(WIDTH, HEIGHT, K, look_at(np.array(centre), np.array(target, float)))


def _picture(camera: Camera) -> np.ndarray:
    """A wall of many colours across x; grey where a camera looks away from it."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays_d = camera.directions(np.stack([u, v], axis=-1))
    if rays_d[0, 0, 0] < 0:
        return np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    t = (WALL - camera.centre[0]) / rays_d[..., 0]
    y, z = (camera.centre + t[..., None] * rays_d)[..., 1:].transpose(2, 0, 1)
    rgb = 0.5 + 0.4 * np.stack([np.sin(2 * y), np.sin(2 * z), np.sin(y + z)], axis=-1)
    return (255 * rgb).round().astype(np.uint8)


def test_a_wall_right_behind_one_camera_that_others_see_stays() -> None:
    """Space nearer than the near plane of a camera is not emptied for all: only its own rays begin farther away."""
    away = _camera(AT, 0.0, 0.0, target=(0, 0, 0))
    others = [
        _camera(-2.0, y, z, target=(WALL, y / 2, z / 2))
        for y in (-1.2, -0.6, 0.0, 0.6, 1.2)
        for z in (-0.5, 0.5)
    ]
    cameras = [away, *others]
    frames = tuple(
        PosedFrame(Path(f"{n}.png"), c, "static", n, None, None, "train") for n, c in enumerate(cameras)
    )
    across = np.linspace(-0.6, 0.6, 13)
    xyz = np.array([[WALL, y, z] for y in across for z in across])
    # every camera but the one before the wall sees all of the points
    seen = np.array([(p, f) for p in range(len(xyz)) for f in range(1, len(frames))])
    scene = scene_of(frames, near=NEAR, far=8.0, points=SparsePoints(xyz, seen[:, 0], seen[:, 1]))
    rays = RaySet.of_pictures(frames, 1.0, map(_picture, cameras))
    options = replace(
        preset("tiny").canonical, coarse_iterations=60, coarse_rays=1024, coarse_size=32, seed=0
    )
    log, generator = TrainingLog("cpu", 1000), torch.Generator().manual_seed(0)
    model = train_coarse(scene, partial(rays.draw, generator=generator), options, generator, log)

    def raw(x: float) -> torch.Tensor:
        at = torch.tensor([[x, y, z] for y in (-0.3, 0.0, 0.3) for z in (-0.3, 0.0, 0.3)])
        return trilinear(model.grid[..., :1].contiguous(), contract(at, model.contraction), CUBE)[:, 0]

    def alpha(x: float) -> torch.Tensor:
        s = model.surroundings()
        return 1 - torch.exp(-s.interval * torch.nn.functional.softplus(raw(x) + s.shift))

    assert np.linalg.norm(away.centre - [WALL, 0, 0]) < NEAR
    assert float(alpha(WALL).min()) > 100 * model.alpha_threshold
    assert float(alpha(AT / 2).max()) < model.alpha_threshold
