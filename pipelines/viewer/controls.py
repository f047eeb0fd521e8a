"""The panel, one for all visitors: the run's standing, time, what is shown, what stands in the scene."""

import time
from collections.abc import Callable

import viser

from devrf.pipelines.viewer.scene_widgets import GROUPS
from devrf.pipelines.viewer.source import Loaded
from devrf.reconstruct.rendering.model import DynamicModel

EVERYTHING: str = "everything"
STANDS, PART = "what stands", "part"
BEHIND = "white"  # a part that is shown alone
STEP_S = 0.001  # of the time slider


class Controls:
    """The panel.

    Args:
        gui: Where it stands.
        changed: Called when another picture is wanted.
        home: Called when the first view is wanted again.
    Attributes:
        groups: By name whether things are wanted in the scene.
        shown: What is wanted of the model, as `some_of` takes it.
        runs: Whether time runs.
    """

    def __init__(self, gui: viser.GuiApi, changed: Callable[[], None], home: Callable[[], None]) -> None:
        self._changed, self.runs, self._asked = changed, False, 0.0
        self._standing = gui.add_html("")
        self._slider = gui.add_slider("time, s", 0.0, 1.0, STEP_S, 0.0, visible=False)
        self._slider.on_update(lambda event: self.run(False) if event.client is not None else None)
        self._play = gui.add_button("Play", visible=False)
        self._play.on_click(lambda event: self.run(not self.runs))
        hint = "The scene as the sweep saw it: the canonical model"
        self._at_rest = gui.add_checkbox("at rest", False, visible=False, hint=hint)
        self.shown = gui.add_dropdown("shows", (EVERYTHING,))
        self.groups = {name: gui.add_checkbox(name, shown) for name, shown in GROUPS.items()}
        for handle in (self._at_rest, self.shown, *self.groups.values()):
            handle.on_update(lambda event: changed())
        gui.add_button("Back to the first view").on_click(lambda event: home())

    def renew(self, loaded: Loaded) -> None:
        """Offer what can be shown now."""
        scene, model = loaded.scene, loaded.model
        self._slider.visible = self._play.visible = scene is not None and bool(scene.dynamic)
        if scene is not None and scene.dynamic:
            first, last = round(scene.t0_s, 3), round(max(scene.t1_s, scene.t0_s + STEP_S), 3)
            if (self._slider.min, self._slider.max) != (first, last):
                self._slider.min, self._slider.max, self._slider.value = first, last, first
        self._at_rest.visible = model is not None and model.motion is not None
        offered = (EVERYTHING,)
        if model is not None and model.movers is not None:
            offered += (STANDS, *(f"{PART} {n + 1}" for n in range(model.movers.parts)))
        if self.shown.options != offered:
            self.shown.options = offered
        for name, box in self.groups.items():
            box.value = model is None or GROUPS[name]

    def say(self, standing: str) -> None:
        """The run's standing, HTML."""
        if self._standing.content != standing:
            self._standing.content = standing

    def moment(self, now: float) -> float | None:
        """The time in [0, 1] at a moment of the clock; None: at rest. Where it runs the slider goes on, and around."""
        first, last = self._slider.min, self._slider.max
        if self.runs:
            at = round(self._slider.value + now - self._asked, 3)
            self._slider.value = at if at <= last else first
        self._asked = now
        still = self._at_rest.value or not self._at_rest.visible
        return None if still else (self._slider.value - first) / (last - first)

    def run(self, runs: bool) -> None:
        """Let time run, or stand."""
        self._asked, self.runs = time.monotonic(), runs
        self._play.label = "Pause" if runs else "Play"
        self._changed()


def some_of(whole: DynamicModel, shown: str) -> DynamicModel:
    """What the panel names of a model; without what stands, nobody knows what surroundings look like behind it."""
    if shown == STANDS:
        return whole.showing(True, ())
    if shown.startswith(PART):
        return whole.showing(False, (int(shown.removeprefix(PART)),)).alone(BEHIND)
    return whole
