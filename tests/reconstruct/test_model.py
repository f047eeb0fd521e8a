"""A model is rendered with what memory there is."""

import numpy as np
import pytest
import torch
from tests.make.models import before_random_model, random_model

from devrf.reconstruct.rendering import model as models
from devrf.reconstruct.rendering.model import CHUNK, FEWEST_AT_ONCE, render_layers, render_view


def test_a_full_gpu_is_tried_again_with_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = before_random_model().scaled(4.0)
    expected = render_view(random_model("white"), camera, None)
    render_rest, most, tried = models.render_rest, 1 << 10, []

    def full(canonical, behind, rays):
        tried.append(len(rays.o))
        if len(rays.o) > most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB")
        return render_rest(canonical, behind, rays)

    monkeypatch.setattr(models, "render_rest", full)
    model = random_model("white")
    np.testing.assert_allclose(render_view(model, camera, None), expected, atol=1e-6)
    assert model.chunk == most < CHUNK and max(tried) > most
    most = FEWEST_AT_ONCE - 1
    with pytest.raises(torch.OutOfMemoryError):
        render_view(model, camera, None)


@pytest.mark.parametrize("background", ["white", "shell"])
def test_a_rough_picture_differs_only_in_its_surroundings(background: str) -> None:
    camera = before_random_model().scaled(4.0)
    exact, depth, opacity = render_layers(random_model(background), camera, 0.3)
    model = random_model(background)
    rough, rough_depth, rough_opacity = render_layers(model, camera, 0.3, roughly=True)
    np.testing.assert_array_equal(depth, rough_depth)
    np.testing.assert_array_equal(opacity, rough_opacity)
    error = np.abs(rough - exact)
    if background == "white":
        assert not error.any()
    else:
        assert error.any() and np.sqrt((error**2).mean()) < 0.1 * exact.std() + 0.02
        model.around_camera(camera)  # what is remembered is taken as it is
        np.testing.assert_array_equal(render_layers(model, camera, 0.3, roughly=True)[0], exact)


def test_a_picture_can_be_given_up_between_two_parts() -> None:
    model, untouched = random_model("shell"), random_model("shell")
    camera, parts = before_random_model().scaled(4.0), []
    model.chunk = untouched.chunk = 1 << 9

    def third() -> None:
        parts.append(1)
        if len(parts) == 3:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        render_layers(model, camera, None, between=third)
    assert len(parts) == 3
    whole = render_view(model, camera, None)  # what was begun does no harm
    np.testing.assert_array_equal(whole, render_view(untouched, camera, None))


def test_what_is_remembered_of_a_time_changes_nothing() -> None:
    model = random_model("white")
    first = render_view(model, before_random_model(), 0.7)
    for time in np.linspace(0, 1, models.CACHED_TIMES + 5):
        model.live_at(float(time))
    assert len(model._live) <= models.CACHED_TIMES
    np.testing.assert_array_equal(render_view(model, before_random_model(), 0.7), first)


def test_what_is_in_the_box_alone_has_no_surroundings() -> None:
    model, camera = random_model("shell"), before_random_model().scaled(2.0)
    whole, depth, opacity = render_layers(model, camera, 0.4)
    alone, same_depth, same_opacity = render_layers(model.alone("white"), camera, 0.4)
    np.testing.assert_array_equal(depth, same_depth)
    np.testing.assert_array_equal(opacity, same_opacity)
    np.testing.assert_allclose(alone[opacity == 0], 1.0)
    assert not np.allclose(alone, whole, atol=0.05)
    assert not model.alone("white")._around and model._around
    assert model.rest.shell is not None
