"""Flow of cameras, held against their pictures."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter, shift
from tests.reconstruct.conftest import held_rays

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame
from devrf.flow.agreement import MOSTLY_CONTRADICTED
from devrf.flow.store import BEST, CameraFlow
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.checked_flow import checked_flow
from devrf.reconstruct.sampling.moving_pixels import changing_pixels
from devrf.reconstruct.sampling.pixel_flow import PixelFlow

WIDTH, HEIGHT, STEP = 64, 48, 2.0  # the pattern goes right by so many pixels from picture to picture
NAMES = ("cam0", "cam1")


def _rays() -> RaySet:
    """Two cameras, three pictures of each; those of the second have the numbers 0, 2 and 4."""
    pattern = gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)), (2, 2, 0))
    pattern = 128 + 40 * pattern / pattern.std()
    pictures = [
        shift(pattern, (0, STEP * n, 0), mode="nearest").clip(0, 255).astype(np.uint8) for n in range(3)
    ]
    camera = Camera(WIDTH, HEIGHT, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), np.eye(4)[:3])
    rays = held_rays([camera] * 6, pictures * 2, [0.0, 0.5, 1.0] * 2)
    rays.frames = tuple(
        PosedFrame(Path(), camera, name, step * n, n / 2, n / 2, "train")
        for name, step in zip(NAMES, (1, 2), strict=True)
        for n in range(3)
    )
    return rays


def _clip(name: str, index: list[int], u: float, size: tuple[int, int] = (HEIGHT, WIDTH)) -> CameraFlow:
    flow = np.zeros((len(index), *size, 2), np.float16)
    flow[..., 0] = u
    confidence = np.full(flow.shape[:3], BEST, np.uint8)
    return CameraFlow(name, np.array(index, np.int32), flow, confidence > 0, confidence)


def test_a_camera_whose_flow_is_reversed_is_found_and_does_not_count() -> None:
    rays = _rays()
    checked = checked_flow(rays, {"cam0": _clip("cam0", [1, 2], -STEP), "cam1": _clip("cam1", [2, 4], STEP)})
    assert checked.contradicted["cam0"] < 0.15 and checked.contradicted["cam1"] > 0.95
    assert checked.flows["cam0"].valid.mean() > 0.85 and not checked.flows["cam1"].valid.any()
    pixel = torch.full((2,), HEIGHT // 2 * WIDTH + WIDTH // 2)
    _, _, confidence, agrees = PixelFlow(rays, checked.flows, True).at(torch.tensor([1, 4]), pixel)
    assert confidence.tolist() == [1, 1] and agrees[0] > 0.8 and agrees[1] == 0


def test_nothing_is_left_of_a_pair_that_is_mostly_contradicted() -> None:
    """Not even what happens to agree: it comes from the same hand."""
    clip = _clip("cam0", [1, 2], -STEP)
    clip.flow[1, :, 10:] *= -1
    checked = checked_flow(_rays(), {"cam0": clip})
    first, second = checked.flows["cam0"].valid
    assert first.mean() > 0.8 and not second.any()
    assert checked.contradicted["cam0"] < MOSTLY_CONTRADICTED


def test_a_pair_in_which_hardly_anything_moves_is_not_judged_by_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its vectors say that nothing moves, which is right but for a spot: too little to drop all of them."""
    monkeypatch.setattr(
        "devrf.reconstruct.sampling.checked_flow.FEWEST_ASKED", 0.05
    )  # a spot of so small a picture
    rays = _rays()
    pictures = rays.pixels.view(6, HEIGHT, WIDTH, 3)
    pictures[2] = pictures[1]
    pictures[2, 20:22, 20:22] = 255 - pictures[1, 20:22, 20:22]
    clip = _clip("cam0", [1, 2], -STEP)
    clip.flow[1] = 0
    checked = checked_flow(rays, {"cam0": clip})
    assert 0.9 < checked.flows["cam0"].valid[1].mean() < 1


def test_what_cannot_be_asked_stays_as_it_is() -> None:
    flows = {"cam0": _clip("cam0", [1, 2], STEP, (24, 32)), "other": _clip("other", [1], STEP)}
    checked = checked_flow(_rays(), flows)
    assert checked.contradicted == {}
    assert all(clip.valid.all() for clip in checked.flows.values())


def test_noise_does_not_make_still_pixels_move() -> None:
    """Rays are drawn where pictures change or flow moves: not where only flow says so."""
    rays = _rays()
    rays.pixels[:] = rays.pixels[: HEIGHT * WIDTH].repeat(6, 1)
    flows = {"cam0": _clip("cam0", [1, 2], STEP)}
    assert len(changing_pixels(rays, flows).of_frame[0]) > 0.9 * HEIGHT * WIDTH
    assert len(changing_pixels(rays, checked_flow(rays, flows).flows).of_frame[0]) < 0.05 * HEIGHT * WIDTH
