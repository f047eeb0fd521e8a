"""What a visitor's panel says: the moment that is shown, and what is behind the box alone."""

from types import SimpleNamespace
from typing import Any

import pytest
from tests.pipelines.trained_run import boxed_model

from devrf.pipelines.viewer.controls import Controls, place, stepped
from devrf.pipelines.viewer.visit import Visit


def test_what_is_in_the_box_alone_is_before_white() -> None:
    controls = SimpleNamespace(alone=True, shown=None)
    visit: Any = SimpleNamespace(_loaded=SimpleNamespace(model=boxed_model()), controls=controls, _some=None)
    alone = Visit._model(visit)
    assert alone.rest.background == "white" and Visit._model(visit) is alone


def test_a_part_alone_is_before_white_and_what_stands_is_not() -> None:
    asked: list[tuple[bool, tuple[int, ...]]] = []

    def showing(*shown: Any) -> SimpleNamespace:
        asked.append(shown)
        return SimpleNamespace(alone=lambda background: f"before {background}")

    model = SimpleNamespace(showing=showing)
    controls = SimpleNamespace(alone=False, shown=(False, (2,)))
    visit: Any = SimpleNamespace(_loaded=SimpleNamespace(model=model), controls=controls, _some=None)
    assert Visit._model(visit) == "before white"
    controls.shown = True, ()
    assert isinstance(Visit._model(visit), SimpleNamespace)
    assert asked == [(False, (2,)), (True, ())]


@pytest.mark.parametrize(
    ("visible", "value", "shown"),
    [
        (True, "everything", None),
        (True, "what stands", (True, ())),
        (True, "part 12", (False, (12,))),
        (False, "part 12", None),  # another model came, without parts
    ],
)
def test_parts_can_be_chosen_where_there_are_any(visible: bool, value: str, shown: object) -> None:
    panel: Any = SimpleNamespace(_parts=SimpleNamespace(visible=visible, value=value))
    assert Controls.shown.fget(panel) == shown  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("way", "step", "there_and_back", "places"),
    [
        (0.5, 0.25, False, [0.5, 0.75, 1.0, 0.25, 0.5]),
        (1.0, 0.5, False, [1.0, 0.5, 1.0]),  # it stands at the end, and begins anew
        (0.0, 0.5, True, [0.0, 0.5, 1.0, 0.5, 0.0, 0.5]),
        (1.5, 0.25, False, [0.5, 0.75]),  # on the way back, where it then is there and back no more
    ],
)
def test_time_runs_around_or_there_and_back(
    way: float, step: float, there_and_back: bool, places: list[float]
) -> None:
    assert place(stepped(way, 0.0, there_and_back)) == places[0]
    for expected in places:
        assert place(way) == pytest.approx(expected)
        way = stepped(way, step, there_and_back)
