"""Fog right before a new camera is not shown; the box, and what has points, is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.make.models import AABB, COLOUR, moving_ball

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.reconstruct.fields.near_plane import FEWEST, near_plane
from devrf.reconstruct.rendering.model import DynamicModel, render_view

LEAST = 0.1
K = np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])


def _camera(distance: float) -> Camera:
    """Before the middle of the box's face."""
    return Camera(32, 24, K, look_at(np.array([distance, 0, 0]), np.zeros(3)))


def _wall(x: float, n: int = FEWEST) -> torch.Tensor:
    """Points in the camera's picture, one of them in its middle."""
    across = torch.linspace(0.0, 0.1, n)
    return torch.stack([torch.full_like(across, x), across, torch.zeros(n)], dim=1)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        (_wall(3.0), 0.8),
        (_wall(3.0, FEWEST - 1), LEAST),
        (_wall(0.0), 3.0),  # the box begins there
        (torch.cat([_wall(3.0), _wall(3.5, 1)]), 0.4),  # one point that is nearer
        # behind it, beside its picture
        (torch.cat([_wall(3.0), torch.tensor([[4.5, 0, 0], [3.9, 3, 0]])]), 0.8),
        (torch.zeros(0, 3), LEAST),
    ],
)
def test_it_lies_before_all_that_is_known(points: torch.Tensor, expected: float) -> None:
    assert near_plane(_camera(4.0), points, AABB, LEAST) == pytest.approx(expected, abs=1e-6)


def test_fog_before_a_camera_is_not_shown() -> None:
    rest = moving_ball("shell").rest
    assert rest.shell is not None
    camera = _camera(4.0)

    def middle(points: torch.Tensor) -> np.ndarray:
        assert rest.shell is not None
        rest.shell.points = points
        return render_view(DynamicModel(rest), camera, None)[11:13, 15:17].mean((0, 1))

    shell = rest.shell
    x = shell.grid.shape[0] - 1
    shell.grid[..., 0] = -10
    shell.grid[x - 1 :, ..., 0] = 30  # far out along x, where the camera is
    shell.rebuild_occupancy()
    assert np.abs(middle(torch.zeros(0, 3)) - COLOUR).max() > 0.2
    np.testing.assert_allclose(middle(_wall(0.0)), COLOUR, atol=0.02)
    assert replace(rest, shell=None).near_for(camera) == rest.near
