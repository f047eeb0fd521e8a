"""The models of data sets: they move smoothly and visibly, stay in view, and keep their faces."""

import numpy as np
import pytest

from devrf.lab.simulate.scenes.models import MODELS
from devrf.lab.simulate.scenes.shapes import Model

IN_VIEW = 4 * np.sin(0.6911 / 2)  # the largest ball that a camera at distance 4 sees all of
TIMES = np.linspace(0, 1, 50)


@pytest.fixture(scope="module", params=list(MODELS))
def model(request: pytest.FixtureRequest) -> Model:
    return MODELS[request.param].build(np.random.default_rng(0), 1.0)


def _vertices(model: Model, time: float) -> np.ndarray:
    return np.concatenate([part.vertices_at(time) for part in model])


def test_it_is_at_rest_at_time_0_and_moves_smoothly_by_a_good_part_of_its_size(model: Model) -> None:
    np.testing.assert_array_equal(_vertices(model, 0.0), np.concatenate([p.rest.vertices for p in model]))
    way = np.stack([_vertices(model, float(t)) for t in TIMES])
    assert np.isfinite(way).all()
    size = np.ptp(way[0], axis=0).max()
    assert 2.0 < size < 2.7
    assert np.linalg.norm(way[-1] - way[0], axis=1).max() > 0.2 * size
    steps = np.linalg.norm(np.diff(way, axis=0), axis=2)
    assert steps.max() < 0.1  # no jumps: below 14 pixels of 400
    assert steps[0].max() < 0.005  # it starts from rest


def test_all_of_it_is_in_view_at_all_times(model: Model) -> None:
    assert (
        max(np.linalg.norm(_vertices(model, t), axis=1).max() for t in (0.0, 0.25, 0.5, 0.75, 1.0)) < IN_VIEW
    )


def test_faces_look_outward(model: Model) -> None:
    for time in (0.0, 1.0):
        for part in model:
            mesh = part.at(time)
            a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
            assert (a * np.cross(b, c)).sum() > 0  # six times the enclosed volume
            assert mesh.faces is part.rest.faces and mesh.uv.min() >= 0 and mesh.uv.max() <= 1 + 1e-9


def test_it_is_textured_in_several_colours(model: Model) -> None:
    means = np.array([part.rest.texture.mean((0, 1)) for part in model])
    assert np.ptp(means, axis=0).max() > 60
    assert np.median([part.rest.texture.std((0, 1)).mean() for part in model]) > 15


@pytest.mark.full
def test_motion_scale_and_seed() -> None:
    for kind in MODELS.values():
        still = kind.build(np.random.default_rng(0), 0.0)
        np.testing.assert_allclose(_vertices(still, 1.0), _vertices(still, 0.0), atol=1e-12)
        again, other = (kind.build(np.random.default_rng(seed), 0.0) for seed in (0, 1))
        np.testing.assert_array_equal(still[0].rest.texture, again[0].rest.texture)
        assert (still[0].rest.texture != other[0].rest.texture).any()
