"""Pictures with alpha: straight colours, nothing of the lights, and coverage that agrees."""

import numpy as np
import pytest

from devrf.capture.camera import Camera
from devrf.capture.view_axes import look_at
from devrf.lab.simulate.render.mitsuba import linear_to_srgb
from devrf.lab.simulate.render.studio import Studio, straight_srgb
from devrf.lab.simulate.scenes.catalogue import Mesh

SIZE = 32
K = np.array([[40.0, 0, SIZE / 2], [0, 40.0, SIZE / 2], [0, 0, 1.0]])
CAMERA = Camera(SIZE, SIZE, K, look_at(np.array([0, -4.0, 0]), np.zeros(3)))


def test_straight_srgb_against_the_closed_form() -> None:
    alpha = np.array([[0.0, 0.25, 1.0]])
    colour = np.array([0.1, 0.4, 0.9])
    out = straight_srgb(np.concatenate([alpha[..., None] * colour, alpha[..., None]], -1))
    np.testing.assert_array_equal(out[0, 0], 0)
    for i, a in ((1, 64), (2, 255)):
        np.testing.assert_array_equal(out[0, i], [*(255 * linear_to_srgb(colour)).round(), a])


def test_edges_have_the_surface_s_colour_and_the_lights_are_not_seen() -> None:
    pytest.importorskip("mitsuba")
    quad = np.array([[-0.83, 0, 0.9], [0.83, 0, 0.9], [0.83, 0, -0.9], [-0.83, 0, -0.9]])
    grey = np.full((4, 4, 3), 150, np.uint8)
    uv = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    stage = Studio(spp=64).stage([Mesh(quad, np.array([[0, 2, 1], [0, 3, 2]]), uv, grey)])
    picture = stage.picture(CAMERA, 0)
    alpha = picture[..., 3].astype(float)
    assert (picture[alpha == 0] == 0).all() and (alpha[0] == 0).all()  # the sky is not in the picture
    edge, inside = (alpha > 40) & (alpha < 200), alpha == 255
    assert edge.sum() > 20 and inside.sum() > 200
    middle = picture[inside][:, :3].mean(0)
    assert np.abs(picture[edge][:, :3].mean(0) - middle).max() < 4  # levels; noise of edge pixels is 1 to 2
    assert 60 < middle.mean() < 250 and picture[..., :3].max() < 255
    assert alpha.sum() / 255 == pytest.approx(2 * 0.83 * 2 * 0.9 * 10**2, rel=0.01)  # 10 pixels per unit
    np.testing.assert_allclose(255 * stage.coverage(CAMERA, 0), alpha, atol=255 * 0.1)
