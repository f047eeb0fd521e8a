"""Normalised device coordinates: there and back, straight rays, and planes that start even."""

import numpy as np
import pytest
import torch
from tests.make.models import NDC, planes

from devrf.reconstruct.fields.canonical import refine
from devrf.reconstruct.fields.grids import grid_shape
from devrf.reconstruct.fields.ndc import CUBE, NEAR
from devrf.reconstruct.kernels.composite import composite_weights
from devrf.reconstruct.kernels.march import march
from devrf.reconstruct.rendering.render import distances, points_on, segments_in


def _points(n: int = 500) -> torch.Tensor:
    rng = torch.Generator().manual_seed(0)
    z = NEAR * (1 + 50 * torch.rand(n, generator=rng) ** 3)
    xy = (2 * torch.rand(n, 2, generator=rng) - 1) * z[:, None] * torch.tensor([NDC.tan_x, NDC.tan_y])
    return torch.cat([xy, z[:, None]], dim=1)


def _rays(n: int = 200) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(1)
    o = 0.4 * (torch.rand(n, 3, generator=rng) - 0.5)
    d = torch.cat([0.6 * (torch.rand(n, 2, generator=rng) - 0.5), torch.ones(n, 1)], dim=1)
    return o, torch.nn.functional.normalize(d, dim=1)


def test_world_and_back() -> None:
    x = _points()
    inside = NDC.from_world(x)
    assert (inside.abs() <= 1 + 1e-5).all()
    torch.testing.assert_close(NDC.to_world(inside), x, rtol=1e-4, atol=1e-5)


def test_known_points() -> None:
    corner = torch.tensor([[0.6 * NEAR, -0.45 * NEAR, NEAR]])
    torch.testing.assert_close(NDC.from_world(corner), torch.tensor([[1.0, -1.0, -1.0]]))
    far = NDC.from_world(torch.tensor([[0.0, 0.0, 1e6]]))
    torch.testing.assert_close(far, torch.tensor([[0.0, 0.0, 1.0]]), atol=1e-5, rtol=0)


def test_a_straight_ray_stays_straight() -> None:
    """Points along rays in the world lie on the transformed rays, at t = z' + 1."""
    o, d = _rays()
    o_ndc, d_ndc = NDC.rays(o, d)
    for depth in (1.2, 3.0, 40.0):
        x = NDC.from_world(o + ((depth - o[:, 2]) / d[:, 2])[:, None] * d)
        torch.testing.assert_close(o_ndc + (x[:, 2:] + 1) * d_ndc, x, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(d_ndc[:, 2], torch.ones(len(o)))


def test_rays_that_look_away_miss() -> None:
    o = torch.zeros(2, 3)
    d = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    segments = segments_in(CUBE, NDC, o, d, 0.5, torch.full((2,), 0.5))
    assert (segments.t_out <= segments.t_in).all()


@pytest.mark.parametrize("count", [9, 32, 128])
def test_planes_start_equally_likely_to_stop_a_ray(count: int) -> None:
    model = planes(count)
    o, d = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]])
    segments = segments_in(CUBE, NDC, o, d, 0.0, torch.full((1,), 0.5))
    samples = march(segments, model.volume())
    x = points_on(segments, samples)
    weights, left = composite_weights(model.alpha(x), samples.offsets)
    plane = ((x[:, 2] + 1) / 2 * (count - 1)).round().long()
    per_plane = torch.zeros(count).index_add_(0, plane, weights)
    assert float(left) < 0.02  # the last plane is opaque
    inner = per_plane[1 : count - 2]
    assert float((inner * count - 1).abs().max()) < 0.25, inner * count


def test_planes_stay_when_the_grid_is_refined() -> None:
    model = planes(16)
    before, step = model.shape, model.step
    refine(model, 48)
    assert model.shape[2] == before[2] == 16 and model.shape[0] > 2 * before[0]
    assert model.step == pytest.approx(step)
    assert grid_shape(CUBE, 256, 128) == (362, 362, 128)  # the published program's 256^3 over 128 planes


def test_distances_are_those_of_the_world() -> None:
    o, d = _rays(50)
    model = planes()
    segments = segments_in(CUBE, NDC, o, d, 0.0, torch.full((50,), 0.5))
    samples = march(segments, model.volume())
    away = distances(points_on(segments, samples), samples, NDC, o)
    near_part = samples.t < 1.5
    x = o[samples.ray_id] + away[:, None] * d[samples.ray_id]
    expected = NDC.to_world(points_on(segments, samples))
    np.testing.assert_allclose(x[near_part].numpy(), expected[near_part].numpy(), rtol=2e-3, atol=2e-3)
