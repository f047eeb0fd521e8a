"""Motion in closed form: a rigid step is recovered, flow agrees with the true motion, the cycle's gradient is exact."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tests.make.models import still
from tests.reconstruct.conftest import REST, held_rays

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame
from devrf.flow.store import CameraFlow
from devrf.reconstruct.fields.grids import voxel_size
from devrf.reconstruct.kernels.quad import quad
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.sampling.pixel_flow import PUBLISHED_WIDTH, PixelFlow
from devrf.reconstruct.training.losses import cycle_loss, flow_loss
from devrf.reconstruct.training.train_canonical import train_canonical
from devrf.reconstruct.training.train_motion import train_motion

BOX = torch.tensor([[-1.0, -0.8, -0.6], [1.0, 0.8, 0.6]])
# one picture to the next, box units: more than a voxel, within reach of the rates
STEP = np.array([0.03, -0.02, 0.025])
COARSER = replace(REST, resolution=36, iterations=150, scale_at=(0.3,))


@pytest.mark.full
def test_one_rigid_step_is_recovered_to_a_tenth_of_a_voxel(ball, tmp_path: Path) -> None:
    """The published losses, schedule in small; the pictures are the model's own, so nothing else is wrong."""
    rest = train_canonical(ball.scene, COARSER)
    model = DynamicModel(rest)
    cameras = [f.camera for f in ball.scene.static if f.split == "train"][::4]
    frames = []
    for n, camera in enumerate(cameras):
        for index in (0, 1):
            moved = camera.moved(np.block([[np.eye(3), -index * STEP[:, None]], [np.zeros((1, 3)), 1]]))
            path = tmp_path / f"{n}_{index}.png"
            Image.fromarray((render_view(model, moved, None) * 255).round().astype(np.uint8)).save(path)
            time = float(index)
            frames.append(PosedFrame(path, camera, f"cam{n}", index, time, time, "train"))
    options = MotionOptions(
        levels=(3, 6, 12), iterations=(200, 100, 100), rays=1024, lr=1e-3, one_camera=True
    )
    motion, _ = train_motion(replace(ball.scene, dynamic=tuple(frames)), rest, {}, options)
    directions = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    surface = torch.nn.functional.normalize(directions, dim=-1) * 0.95 * ball.radius
    tau, step = torch.ones(500), torch.from_numpy(STEP).float()
    tenth = 0.1 * voxel_size(rest.canonical.aabb, rest.canonical.shape)
    forward = (motion.from_rest(surface, tau) - surface).mean(0)
    backward = (motion.to_rest(surface + step, tau) - surface - step).mean(0)
    assert float((forward - step).norm()) < tenth, (forward, tenth)
    assert float((backward + step).norm()) < tenth, (backward, tenth)


@pytest.mark.parametrize("size", [(60, 40), (40, 60)])
def test_flow_loss_is_zero_at_the_true_motion(size: tuple[int, int]) -> None:
    """A wall that slides by a third of a pixel and more per picture, before cameras that have little in common."""
    slide = np.array([0.05, -0.02, 0.0])
    cameras, names = [], []
    for n, (focal, off) in enumerate([(70.0, 0.0), (55.0, 3.3)]):
        K = np.array([[focal, 0, size[0] / 2 + off], [0, 1.1 * focal, size[1] / 2 - off], [0, 0, 1.0]])
        for _ in range(3):
            cameras.append(Camera(*size, K, np.column_stack([np.eye(3), [0.1 * n, 0.0, 3.0]])))
            names.append(f"cam{n}")
    blank = [np.zeros((size[1], size[0], 3), np.uint8)] * 6
    rays = held_rays(cameras, blank, [0.0, 0.5, 1.0] * 2)
    rays.frames = tuple(
        PosedFrame(Path(), c, name, n % 3, n % 3 / 2, n % 3 / 2, "train")
        for n, (c, name) in enumerate(zip(cameras, names, strict=True))
    )
    flows = {}
    for name, camera in (("cam0", cameras[0]), ("cam1", cameras[3])):
        px = -slide[:2] / 3.0 * [camera.K[0, 0], camera.K[1, 1]]  # the wall is at z = 0 of the world, 3 ahead
        field = np.broadcast_to(px, (2, size[1], size[0], 2)).astype(np.float16)
        flows[name] = CameraFlow(name, np.array([1, 2], np.int32), field, np.ones(field.shape[:3], bool))
    flow = PixelFlow(rays, flows)
    rng = np.random.default_rng(0)
    frame = torch.from_numpy(rng.choice([1, 2, 4, 5], 300))
    pixel = torch.from_numpy(rng.integers(0, size[0] * size[1], 300))
    batch = rays.at(frame, pixel)
    x = batch.rays_o - batch.rays_o[:, 2:] / batch.rays_d[:, 2:] * batch.rays_d
    target, previous, valid, agreement = flow.at(frame, pixel)
    assert (agreement == 1).all() and valid.float().mean() > 0.8 and (previous == frame - 1).all()
    was = x - torch.from_numpy(slide).float()
    weights = torch.ones(300)
    exact = flow_loss(flow.project(was, frame), target, weights, valid, agreement)
    still = flow_loss(flow.project(x, frame), target, weights, valid, agreement)
    assert exact < 2e-3 * PUBLISHED_WIDTH / min(size) and still > 50 * exact


@pytest.mark.parametrize(("weighted", "expected"), [(True, [0.2, 1.0, 0.0]), (False, [1.0, 1.0, 0.0])])
def test_flow_counts_by_its_confidence(weighted: bool, expected: list[float]) -> None:
    camera = Camera(8, 6, np.array([[8.0, 0, 4], [0, 8, 3], [0, 0, 1]]), np.eye(4)[:3])
    rays = held_rays([camera] * 2, [np.zeros((6, 8, 3), np.uint8)] * 2, [0.0, 1.0])
    rays.frames = tuple(PosedFrame(Path(), camera, "cam0", n, float(n), float(n), "train") for n in range(2))
    confidence = np.full((1, 6, 8), 15, np.uint8)
    confidence[0, 2, 3:6] = 3, 15, 0
    flow = CameraFlow(
        "cam0", np.array([1], np.int32), np.zeros((1, 6, 8, 2), np.float16), confidence > 0, confidence
    )
    pixel = torch.tensor([2 * 8 + 3, 2 * 8 + 4, 2 * 8 + 5])
    _, _, found, _ = PixelFlow(rays, {"cam0": flow}, weighted).at(torch.ones(3, dtype=torch.int64), pixel)
    torch.testing.assert_close(found, torch.tensor(expected))


def test_gradient_of_the_cycle_against_float64() -> None:
    """Through both lookups, with respect to both fields (Eq. 5)."""
    rng = torch.Generator().manual_seed(1)
    fields = [0.1 * torch.randn(3, 4, 5, 4, 3, generator=rng) for _ in range(2)]
    points = (BOX[1] - BOX[0]) * (torch.rand(200, 3, generator=rng) * 0.8 + 0.1) + BOX[0]
    tau = 2 * torch.rand(200, generator=rng)
    backward, forward = (f.clone().requires_grad_() for f in fields)
    x0 = points + quad(backward, points, tau, BOX)
    cycle_loss(points, x0 + quad(forward, x0, tau, BOX)).backward()

    exact = [f.double().requires_grad_() for f in fields]
    y0 = points.double() + _blend(exact[0], points.double(), tau.double())
    (0.5 * ((points - (y0 + _blend(exact[1], y0, tau.double()))) ** 2).sum(-1)).mean().backward()
    for ours, true in zip((backward, forward), exact, strict=True):
        assert ours.grad is not None and true.grad is not None
        torch.testing.assert_close(ours.grad.double(), true.grad, rtol=1e-3, atol=1e-7)


def _blend(field: torch.Tensor, x: torch.Tensor, tau: torch.Tensor) -> torch.Tensor:
    """Quad interpolation written out in float64 by PyTorch's own trilinear lookup."""
    grid = 2 * (x - BOX[0]) / (BOX[1] - BOX[0]) - 1
    key = tau.floor().long().clamp(max=len(field) - 2)
    volumes = field.permute(0, 4, 3, 2, 1)
    at = torch.nn.functional.grid_sample(
        volumes, grid.expand(len(field), 1, 1, -1, 3), align_corners=True, padding_mode="border"
    )[:, :, 0, 0].permute(0, 2, 1)
    n = torch.arange(len(x))
    return torch.lerp(at[key, n], at[key + 1, n], (tau - key)[:, None])


def test_first_key_stays_the_identity_and_any_window_gives_the_same() -> None:
    rng = torch.Generator().manual_seed(2)
    motion = still(BOX, 6, 5)
    motion.backward[1:] = 0.1 * torch.randn(5, *motion.backward.shape[1:], generator=rng)
    x = (BOX[1] - BOX[0]) * torch.rand(50, 3, generator=rng) + BOX[0]
    assert torch.equal(motion.to_rest(x, torch.zeros(50)), x)
    for time in (0.0, 0.13, 0.5, 0.99, 1.0):
        part, tau = motion.at(time, "cpu")
        whole = motion.to_rest(x, motion.tau(torch.full((50,), time)))
        torch.testing.assert_close(part.to_rest(x, tau.expand(50).contiguous()), whole)
    window = motion.window(0, 2, "cpu")
    assert window.rest_key == 0 and motion.window(2, 4, "cpu").rest_key is None
    assert window.backward.data_ptr() == motion.backward.data_ptr()  # the same memory on the same device
