"""The field at a time is what pictures are made of: rays put together from its answers give the rendered picture."""

import numpy as np
import pytest
import torch
from tests.make.models import before_random_model, planes, random_model

from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.geometry.field import AT_ONCE, Field, field_at, opacity, opacity_grid
from devrf.reconstruct.rendering.model import DynamicModel, render_layers
from devrf.reconstruct.rendering.rays import camera_rays
from devrf.reconstruct.rendering.render import segments_in


def _by_hand(model: DynamicModel, time: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Picture and opacity on white: every step of every ray asked of the field, composited densely."""
    field, canonical = field_at(model, time), model.rest.canonical
    rays_o, rays_d = camera_rays(before_random_model())
    middle = torch.full((len(rays_o),), 0.5)
    segments = segments_in(field.aabb, canonical.ndc, rays_o, rays_d, model.rest.near, middle)
    steps = int((segments.t_out - segments.t_in).max() / canonical.step) + 1
    t = segments.t_in[:, None] + (torch.arange(steps) + 0.5) * canonical.step
    x = (segments.rays_o[:, None] + t[..., None] * segments.rays_d[:, None]).reshape(-1, 3)
    alpha = (1 - torch.exp(-canonical.step * field.density(x))).reshape(t.shape)
    alpha = torch.where((t < segments.t_out[:, None]) & (alpha > canonical.alpha_threshold), alpha, 0.0)
    trans = torch.cumprod(1 - alpha, dim=1)
    weights = alpha * torch.cat([torch.ones(len(t), 1), trans[:, :-1]], dim=1)
    colours = field.colours(x, rays_d.repeat_interleave(steps, 0)).reshape(*t.shape, 3)
    rgb = (weights[..., None] * colours).sum(1) + trans[:, -1:]
    size = (before_random_model().height, before_random_model().width)
    return rgb.reshape(*size, 3).numpy(), weights.sum(1).reshape(size).numpy()


@pytest.mark.parametrize("time", [None, 0.0, 0.35, 1.0])
def test_pictures_are_made_of_the_field(time: float | None) -> None:
    model = random_model("white")
    picture, opacity = _by_hand(model, time)
    expected, _, covered = render_layers(model, before_random_model(), time)
    assert 0.1 < covered.mean() < 1  # something is seen, and something is not
    # the march drops samples of weight 1e-4, of which a ray has tens
    np.testing.assert_allclose(opacity, covered, atol=5e-3)
    np.testing.assert_allclose(picture, expected, atol=5e-3)


def test_pictures_in_motion_are_made_of_the_tuned_scene() -> None:
    model = random_model("white")
    model.in_motion = random_model("white", seed=1).rest
    assert field_at(model, 0.5).canonical is model.in_motion.canonical
    assert field_at(model, None).canonical is model.rest.canonical
    picture, _ = _by_hand(model, 0.5)
    np.testing.assert_allclose(picture, render_layers(model, before_random_model(), 0.5)[0], atol=5e-3)


@pytest.mark.full
def test_planes_in_front_of_a_reference_camera() -> None:
    canonical = planes()
    canonical.density += torch.randn(canonical.density.shape, generator=torch.Generator().manual_seed(0))
    canonical.rebuild_occupancy()
    model = DynamicModel(RestModel(canonical, None, "white", 1.0, 100.0, {}))
    picture, opacity = _by_hand(model, None)
    expected, _, covered = render_layers(model, before_random_model(), None)
    np.testing.assert_allclose(opacity, covered, atol=5e-3)
    np.testing.assert_allclose(picture, expected, atol=5e-3)
    field = Field(canonical)
    box = torch.tensor([[0.1, -0.2, 1.5], [1.0, 1.0, 20.0]])
    torch.testing.assert_close(field.to_box(field.from_box(box)), box)


def test_a_grid_is_asked_block_by_block() -> None:
    field = field_at(random_model(), 0.4)
    shape = (40, 120, 130)  # three blocks, the last one smaller
    assert 2 * AT_ONCE < np.prod(shape)
    grid = opacity_grid(field, shape)
    x = vertices(field.aabb, shape).reshape(-1, 3)
    some = torch.randint(len(x), (1000,), generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(grid.reshape(-1)[some], opacity(field, x[some]))
    assert (opacity(field, x[some] + 3.0) == 0).all()  # beyond the box there is nothing


def test_there_and_back() -> None:
    field = field_at(random_model(), 0.4)
    assert field.motion is not None
    x = 0.5 * torch.rand(50, 3)
    torch.testing.assert_close(field.from_rest(x), x)  # this model has no forward motion
    assert (field.to_rest(x) != x).any(1).all()
    torch.testing.assert_close(field.at_rest().to_rest(x), x)
    torch.testing.assert_close(field.features(x), field.at_rest().features(field.to_rest(x)))
