"""The panel of one visitor: the run's standing, time, what is shown, what stands in the scene, facts."""

import time
from collections.abc import Callable
from typing import Any

import viser

from devrf.pipelines.viewer.furniture import GROUPS
from devrf.pipelines.viewer.playback import Playback
from devrf.pipelines.viewer.source import Loaded

LAYERS = ("colour", "depth", "opacity", "confidence")
SPEEDS = {"¼ ×": 0.25, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0}
NO_ARROWS, FROM_REST, TO_NEXT = "none", "from rest to now", "from now to the next key time"
STEP_S = 0.001  # of the time slider
SLIDER_S = 0.1  # between two moves of the slider while time runs
SHOWN_AT_FIRST = {
    "moving cameras"
}  # the first view is often a test camera's, and the sweep passed everywhere


def themed(gui: viser.GuiApi, dark: bool) -> None:
    """Light or dark, without what belongs to viser's makers."""
    gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=dark)


class Controls:
    """The panel.

    Args:
        client: The visitor.
        changed: Called when another picture is wanted.
        show: Called with a group of things in the scene and whether it is visible.
        home: Called when the first view is wanted again.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        changed: Callable[[], None],
        show: Callable[[str, bool], None],
        home: Callable[[], None],
    ) -> None:
        self._gui, self._changed = client.gui, changed
        self.playback = Playback(1.0)
        self._t0_s, self._moved = 0.0, 0.0
        self._standing = self._gui.add_html("")
        self._time = self._gui.add_folder("Time", visible=False)
        with self._time:
            self._add_time()
        with self._gui.add_folder("Picture"):
            self._layer = self._input(self._gui.add_dropdown("shows", LAYERS))
            self._around = self._input(
                self._gui.add_checkbox(
                    "surroundings",
                    True,
                    visible=False,
                    hint="Without them the box can be seen from everywhere",
                )
            )
            self._note = self._gui.add_markdown("", visible=False)
        with self._gui.add_folder("In the scene"):
            self._boxes = {name: self._gui.add_checkbox(name, name in SHOWN_AT_FIRST) for name in GROUPS}
            for name, box in self._boxes.items():
                box.on_update(lambda event, name=name: show(name, event.target.value))
            self._arrows = self._input(
                self._gui.add_dropdown("motion arrows", (NO_ARROWS, FROM_REST, TO_NEXT), visible=False)
            )
        self._gui.add_button("Back to the first view").on_click(lambda event: home())
        self._dark = self._input(self._gui.add_checkbox("dark page", False))
        self._dark.on_update(lambda event: themed(self._gui, event.target.value))
        with self._gui.add_folder("Facts", expand_by_default=False):
            self._facts = self._gui.add_markdown("")

    def renew(self, standing: str, facts: str, loaded: Loaded) -> None:
        """Say what is shown now, and offer what it can do."""
        scene, model = loaded.scene, loaded.model
        self.say(standing)
        self._facts.content = facts
        if scene is not None and scene.dynamic:
            self.playback.span_s, self._t0_s = max(scene.t1_s - scene.t0_s, 1e-6), scene.t0_s
            self._move_slider(time.monotonic())
        self._time.visible = scene is not None and bool(scene.dynamic)
        self._around.visible = model is not None and model.rest.shell is not None
        self._at_rest.visible = self._arrows.visible = model is not None and model.motion is not None

    def choose(self, has_model: bool) -> None:
        """What stands in the scene at first: more where no picture can be seen."""
        for name, box in self._boxes.items():
            box.value = not has_model or name in SHOWN_AT_FIRST

    def groups(self) -> list[tuple[str, bool]]:
        """What is wanted in the scene, and what is not."""
        return [(name, box.value) for name, box in self._boxes.items()]

    def say(self, standing: str) -> None:
        """The run's standing, HTML."""
        if self._standing.content != standing:
            self._standing.content = standing

    def note(self, text: str) -> None:
        """A remark on the picture; empty: none."""
        if self._note.content != text:
            self._note.content, self._note.visible = text, bool(text)

    @property
    def dark(self) -> bool:
        """Whether the page is dark."""
        return self._dark.value

    @property
    def layer(self) -> str:
        """What is shown."""
        return self._layer.value

    @property
    def alone(self) -> bool:
        """Whether only what is in the box is wanted."""
        return self._around.visible and not self._around.value

    @property
    def arrows(self) -> str:
        """Which arrows are wanted."""
        return self._arrows.value

    @property
    def at_rest(self) -> bool:
        """Whether the scene at rest is wanted, whatever the time."""
        return self._at_rest.value

    def moment(self, now: float) -> float:
        """The time in [0, 1] at a moment of the clock; the slider follows."""
        if self.playback.runs and now - self._moved > SLIDER_S:
            self._move_slider(now)
        return self.playback.place(now)

    def _add_time(self) -> None:
        gui = self._gui
        self._slider = gui.add_slider("time, s", 0.0, 1.0, STEP_S, 0.0)
        self._slider.on_update(lambda event: self._slid(event.client is not None))
        self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self._play.on_click(lambda event: self._toggle())
        self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 ×")
        self._ping_pong = gui.add_checkbox("there and back", False)
        for handle in (self._speed, self._ping_pong):
            handle.on_update(lambda event: self._retime())
        self._at_rest = self._input(
            gui.add_checkbox("at rest", False, hint="The scene as the sweep saw it: the canonical model")
        )

    def _input(self, handle: Any) -> Any:
        handle.on_update(lambda event: self._changed())
        return handle

    def _slid(self, by_hand: bool) -> None:
        if by_hand:
            self.playback.jump(min(max((self._slider.value - self._t0_s) / self.playback.span_s, 0.0), 1.0))
            self._label()
            self._changed()

    def _toggle(self) -> None:
        now = time.monotonic()
        (self.playback.stop if self.playback.runs else self.playback.go)(now)
        self._label()
        self._move_slider(now)
        self._changed()

    def _retime(self) -> None:
        self.playback.retime(time.monotonic(), SPEEDS[self._speed.value], self._ping_pong.value)
        self._changed()

    def _label(self) -> None:
        self._play.label = "Pause" if self.playback.runs else "Play"
        icons = viser.Icon
        self._play.icon = icons.PLAYER_PAUSE if self.playback.runs else icons.PLAYER_PLAY

    def _move_slider(self, now: float) -> None:
        self._moved, span = now, self.playback.span_s
        ends = round(self._t0_s, 3), round(self._t0_s + span, 3)
        if (self._slider.min, self._slider.max) != ends:
            self._slider.min, self._slider.max = ends
            self._slider.step = STEP_S
        self._slider.value = round(
            min(max(self._t0_s + self.playback.place(now) * span, ends[0]), ends[1]), 3
        )
