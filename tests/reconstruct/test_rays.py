"""Rays: right pixel, direction, colour and time, for lenses and sizes of all kinds."""

import cv2
import numpy as np
import pytest
import torch
from tests.reconstruct.conftest import held_rays

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame
from devrf.reconstruct.kernels.march import intersect
from devrf.reconstruct.rendering import rays as rays_of
from devrf.reconstruct.rendering.rays import RaySet, camera_rays, local_directions

POSE = np.array([[0, 1, 0, 0.1], [0, 0, 1, -0.2], [1, 0, 0, 3.0]])


def _cameras() -> list[Camera]:
    """Two sizes, two focal lengths, principal points off the centre, one strong lens."""
    bent = np.array([-0.2, 0.05, 1e-3, -2e-3, 0.0])
    return [
        Camera(12, 7, np.array([[15, 0, 5.1], [0, 16, 4.2], [0, 0, 1.0]]), POSE),
        Camera(9, 11, np.array([[10, 0, 4.0], [0, 10, 6.5], [0, 0, 1.0]]), POSE, bent),
    ]


def _set() -> RaySet:
    pictures = [
        np.arange(c.height * c.width * 3, dtype=np.uint8).reshape(c.height, c.width, 3) for c in _cameras()
    ]
    return held_rays(_cameras(), pictures, [0.25, 0.75])


def test_rays_pass_through_their_pixels() -> None:
    rays, g = _set(), torch.Generator().manual_seed(0)
    batch = rays.draw(200, g)
    for number, camera in enumerate(_cameras()):
        chosen = batch.frame == number
        points = (batch.rays_o + 2.5 * batch.rays_d)[chosen].numpy().astype(np.float64)
        pixel = batch.pixel[chosen].numpy()
        centres = np.stack([pixel % camera.width, pixel // camera.width], axis=-1) + 0.5
        np.testing.assert_allclose(camera.project(points), centres, atol=1e-4)
        assert (batch.time[chosen] == [0.25, 0.75][number]).all()
    torch.testing.assert_close(batch.rays_d.norm(dim=-1), torch.ones(200))


def test_colours_are_those_of_the_pixels() -> None:
    batch = _set().at(torch.tensor([0, 1]), torch.tensor([5, 20]))
    torch.testing.assert_close(batch.rgb * 255, torch.tensor([[15.0, 16, 17], [60.0, 61, 62]]))


def test_every_pixel_is_drawn_alike() -> None:
    rays, n = _set(), 40000
    batch = rays.draw(n, torch.Generator().manual_seed(1))
    counts = torch.bincount(rays.first[batch.frame] + batch.pixel, minlength=int(rays.first[-1])).double()
    expected = n / len(counts)
    assert (counts - expected).abs().max() < 6 * expected**0.5  # six standard deviations of a count
    only = rays.draw(500, torch.Generator().manual_seed(1), torch.tensor([1]))
    assert (only.frame == 1).all() and only.pixel.max() < 99 and only.pixel.min() >= 0


def test_whole_camera_is_row_by_row() -> None:
    camera = _cameras()[0]
    rays_o, rays_d = camera_rays(camera)
    second_row = camera.directions(np.array([[0.5, 1.5]]))
    np.testing.assert_allclose(rays_d[12].numpy(), second_row[0], atol=1e-6)
    np.testing.assert_allclose(rays_o[0].numpy(), camera.centre, atol=1e-6)


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ([-3.0, 0, 0], [1.0, 0, 0], (2.0, 4.0)),
        ([0.0, 0, 0], [0.0, 0, 1], (0.1, 1.0)),  # from inside: begins at near
        ([-3.0, 2, 0], [1.0, 0, 0], None),  # parallel to a face and outside
        ([3.0, 0, 0], [1.0, 0, 0], None),  # behind the camera
    ],
)
def test_box_is_entered_and_left_where_it_should(origin, direction, expected) -> None:
    aabb = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]])
    t_in, t_out, hit = intersect(torch.tensor([origin]), torch.tensor([direction]), aabb, 0.1)
    assert bool(hit) == (expected is not None)
    torch.testing.assert_close(
        torch.stack([t_in, t_out])[:, 0], torch.tensor(expected if expected else (0.1, 0.1))
    )


def test_cameras_have_the_size_of_their_pictures_whatever_the_scale(tmp_path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((960, 540, 3), np.uint8))
    K = np.array([[500.0, 0, 270], [0, 500.0, 480], [0, 0, 1]])
    frame = PosedFrame(
        tmp_path / "a.png", Camera(540, 960, K, np.eye(4)[:3]), "static", 0, None, None, "train"
    )
    for scale in (0.35136418, 0.608, 0.51):
        rays = RaySet((frame,), scale, "shell")
        assert int(rays.first[-1]) == len(rays.pixels)


def test_directions_are_remembered_by_lens_and_never_mixed_up() -> None:
    cameras = [camera.scaled(scale) for scale in (0.5, 1.0, 1.5) for camera in _cameras()]
    for camera in [*cameras, *reversed(cameras), *cameras[::2]]:
        expected = local_directions(camera) @ camera.world_from_cam[:3, :3].T.astype(np.float32)
        np.testing.assert_array_equal(camera_rays(camera)[1].numpy(), expected)
    assert len(rays_of._directions) <= rays_of.REMEMBERED_LENSES
