"""What is in the box alone: before white, and before black on a dark page."""

from types import SimpleNamespace
from typing import Any

from tests.pipelines.trained_run import boxed_model

from devrf.pipelines.viewer.visit import Visit


def test_behind_the_box_it_is_as_dark_as_the_page() -> None:
    controls = SimpleNamespace(alone=True, dark=False)
    visit: Any = SimpleNamespace(_loaded=SimpleNamespace(model=boxed_model()), controls=controls, _alone=None)
    light = Visit._model(visit)
    assert light.rest.background == "white" and Visit._model(visit) is light
    controls.dark = True
    assert Visit._model(visit).rest.background == "black"
