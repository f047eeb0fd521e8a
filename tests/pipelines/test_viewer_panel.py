"""The panel of the viewer: the moment that is shown, what of the model, and how wide each page sees it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.pipelines.film_folder import halves_model

from devrf.pipelines.viewer.controls import Controls, some_of
from devrf.pipelines.viewer.views import middle


def panel(value: float, at_rest: bool = False, moves: bool = True) -> Any:
    """A panel of a clip from one to three seconds on."""
    slider = SimpleNamespace(min=1.0, max=3.0, value=value)
    rest = SimpleNamespace(value=at_rest, visible=moves)
    return SimpleNamespace(_slider=slider, _at_rest=rest, runs=False, _asked=0.0)


def test_the_slider_says_the_moment() -> None:
    assert Controls.moment(panel(1.5), 10.0) == 0.25
    assert Controls.moment(panel(1.5, at_rest=True), 10.0) is None
    assert Controls.moment(panel(1.5, moves=False), 10.0) is None


def test_time_that_runs_begins_again_after_the_end() -> None:
    shown = panel(2.0)
    shown.runs, shown._asked = True, 10.0
    moments = [Controls.moment(shown, 10.0 + 0.5 * n) for n in range(5)]
    assert moments == [0.5, 0.75, 1.0, 0.0, 0.25] and shown._slider.value == 1.5


def test_what_stands_and_one_part_alone_can_be_chosen() -> None:
    model = halves_model()
    assert some_of(model, "everything") is model
    stands, upper = some_of(model, "what stands"), some_of(model, "part 2")
    assert stands.movers is not None and upper.movers is not None
    assert upper.rest.background == "white"
    assert (stands.movers.labels == 0).all() and set(upper.movers.labels.unique().tolist()) == {0, 2}


@pytest.mark.parametrize(
    ("share", "columns"), [(1.0, [0, 1, 2, 3, 4, 5]), (0.66, [1, 2, 3, 4]), (0.01, [2, 3])]
)
def test_a_narrower_page_sees_the_middle(share: float, columns: list[int]) -> None:
    """What is cut off is as wide on both sides."""
    picture = np.tile(np.arange(6)[None, :, None], (2, 1, 3))
    assert middle(picture, share)[0, :, 0].tolist() == columns
