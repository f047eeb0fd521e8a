"""How far one picture lies beside another: known shifts and zooms of a textured picture, blurred, dimmed and noisy."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from devrf.reconstruct.evaluation.displacement import SEARCH, displacement

SIZE = HEIGHT, WIDTH = 90, 120


def texture() -> np.ndarray:
    rng = np.random.default_rng(0)
    layers = [gaussian_filter(rng.standard_normal((HEIGHT + 40, WIDTH + 40)), s) * s for s in (1, 2, 4)]
    picture = np.sum(layers, axis=0)
    return 0.5 + 0.15 * picture / picture.std()


def seen(zoom: float = 1.0, right: float = 0.0, blur: float = 0.0) -> np.ndarray:
    """The middle of the texture, its contents zoomed about the middle and moved to the right, in pixels."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    cy, cx = (HEIGHT - 1) / 2, (WIDTH - 1) / 2
    at = [20 + cy + (y - cy) / zoom, 20 + cx + (x - cx - right) / zoom]
    picture = map_coordinates(texture(), at, order=3)
    return gaussian_filter(picture, blur) if blur else picture


@pytest.mark.parametrize("right", [0.0, 0.4, 3.0])
def test_a_shift_is_found_between_pixels(right: float) -> None:
    """To 0.05 pixels: a parabola through a correlation peak is biased by less than a tenth of a pixel."""
    found = displacement(seen(), seen(right=right))
    assert found is not None and found.length * WIDTH == pytest.approx(right, abs=0.05)
    assert found.std < 1e-3


def test_a_zoom_moves_a_picture_by_its_distance_from_the_middle() -> None:
    """4 % of the root mean square distance of the blocks' middles; these lie a block within the border."""
    found = displacement(seen(), seen(zoom=1.04))
    half = np.array([WIDTH, HEIGHT]) / 2 - 7.5
    expected = 0.04 * np.sqrt((half**2).sum() / 3)
    assert found is not None and found.length * WIDTH == pytest.approx(expected, rel=0.1)


def test_neither_blur_nor_exposure_nor_noise_nor_a_thing_in_the_way_is_a_shift() -> None:
    other = 0.6 * seen(blur=1.5) + 0.1 + 0.02 * np.random.default_rng(1).standard_normal(SIZE)
    other[30:60, 40:80] = seen(right=7.0)[30:60, 40:80]  # a ninth of the picture shows something else
    found = displacement(seen(), other)
    assert found is not None and found.length * WIDTH < 0.15


def test_where_nothing_is_found_again_it_is_far_away() -> None:
    found = displacement(seen(), np.random.default_rng(2).random(SIZE))
    # rounded to whole pixels
    assert found is not None and not found.found and found.length == pytest.approx(SEARCH, rel=0.1)


def test_where_nothing_can_be_told_nothing_is() -> None:
    flat, stripes = np.full(SIZE, 0.5), 0.5 + 0.4 * np.sin(np.arange(WIDTH))[None].repeat(HEIGHT, 0)
    assert displacement(flat, flat) is None
    assert displacement(stripes, stripes) is None  # along an edge no shift shows
    assert displacement(seen(), seen(), np.zeros(SIZE, bool)) is None  # nothing is asked
    assert displacement(seen()[:6, :6], seen()[:6, :6]) is None  # smaller than a block
