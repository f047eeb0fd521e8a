"""A model is rendered with what memory there is."""

import numpy as np
import pytest
import torch
from tests.reconstruct.test_model_io import _camera, _model

from devrf.reconstruct import model as models
from devrf.reconstruct.model import CHUNK, FEWEST_AT_ONCE, render_view


def test_a_full_gpu_is_tried_again_with_fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = _camera().scaled(4.0)
    expected = render_view(_model("white"), camera, None)
    render_rest, most, tried = models.render_rest, 1 << 10, []

    def full(canonical, shell, plain, rays_o, rays_d, **options):
        tried.append(len(rays_o))
        if len(rays_o) > most:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 3.00 GiB")
        return render_rest(canonical, shell, plain, rays_o, rays_d, **options)

    monkeypatch.setattr(models, "render_rest", full)
    model = _model("white")
    np.testing.assert_allclose(render_view(model, camera, None), expected, atol=1e-6)
    assert model.chunk == most < CHUNK and max(tried) > most
    most = FEWEST_AT_ONCE - 1
    with pytest.raises(torch.OutOfMemoryError):
        render_view(model, camera, None)
