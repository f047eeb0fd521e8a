"""The panel of one visitor: the run's standing, time, what is shown, what stands in the scene."""

import time
from collections import deque
from collections.abc import Callable

import viser

from devrf.pipelines.viewer.furniture import GROUPS
from devrf.pipelines.viewer.source import Loaded

EVERYTHING: str = "everything"
STANDS: str = "what stands"
PART = "part"
LAYERS = ("colour", "depth", "opacity")
SPEEDS = {"¼ ×": 0.25, "½ ×": 0.5, "1 ×": 1.0, "2 ×": 2.0}
STEP_S = 0.001  # of the time slider
SLIDER_S = 0.1  # between two moves of the slider while time runs
# the first view is often a test camera's, and the sweep passed everywhere
SHOWN_AT_FIRST = {"moving cameras"}


def stepped(way: float, step: float, there_and_back: bool) -> float:
    """A way along the clip, in clips, a step later: it begins again after the end, or goes back from there."""
    if there_and_back:
        return (way + step) % 2
    way = place(way) + step
    return way if way <= 1 else way % 1


def place(way: float) -> float:
    """Share of the clip in [0, 1] after a way of up to two clips, there and back."""
    return 1 - abs(1 - way)


class Controls:
    """The panel.

    Args:
        client: The visitor.
        changed: Called when another picture is wanted.
        show: Called with a group of things in the scene and whether it is visible.
        home: Called when the first view is wanted again.
    Attributes:
        layer, at_rest: What is chosen (viser's handles).
        groups: By name whether it is wanted in the scene.
        runs: Whether time runs.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        changed: Callable[[], None],
        show: Callable[[str, bool], None],
        home: Callable[[], None],
    ) -> None:
        gui, self._changed = client.gui, changed
        self.runs, self._way, self._asked, self._slid = False, 0.0, 0.0, 0.0
        self._jumps: deque[float] = deque(maxlen=1)  # where the visitor's hand put the time
        self._t0_s, self._span_s = 0.0, 1.0
        self._standing = gui.add_html("")
        self._time = gui.add_folder("Time", visible=False)
        with self._time:
            self._slider = gui.add_slider("time, s", 0.0, 1.0, STEP_S, 0.0)
            self._slider.on_update(lambda event: self._jump() if event.client is not None else None)
            self._play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
            self._play.on_click(lambda event: self.run(not self.runs))
            self._speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1 ×")
            self._ping_pong = gui.add_checkbox("there and back", False)
            self.at_rest = gui.add_checkbox(
                "at rest", False, hint="The scene as the sweep saw it: the canonical model"
            )
        with gui.add_folder("Picture"):
            self.layer = gui.add_dropdown("shows", LAYERS)
            self._around = gui.add_checkbox(
                "surroundings", True, visible=False, hint="Without them the box can be seen from everywhere"
            )
            self._parts = gui.add_dropdown(
                "of the box",
                (EVERYTHING,),
                visible=False,
                hint="What stands, or one of the parts that move",
            )
            self._note = gui.add_markdown("", visible=False)
        with gui.add_folder("In the scene"):
            self.groups = {name: gui.add_checkbox(name, name in SHOWN_AT_FIRST) for name in GROUPS}
            self._scene_note = gui.add_markdown("", visible=False)
        for name, box in self.groups.items():
            box.on_update(lambda event, name=name: show(name, event.target.value))
        gui.add_button("Back to the first view").on_click(lambda event: home())
        for handle in (self.at_rest, self.layer, self._around, self._parts):
            handle.on_update(lambda event: changed())

    def renew(self, loaded: Loaded) -> None:
        """Offer what can be shown now."""
        scene, model = loaded.scene, loaded.model
        self._time.visible = scene is not None and bool(scene.dynamic)
        if scene is not None and scene.dynamic:
            self._t0_s, self._span_s = scene.t0_s, max(scene.t1_s - scene.t0_s, 1e-6)
            self._slider.min, self._slider.max = round(scene.t0_s, 3), round(scene.t0_s + self._span_s, 3)
            self._slider.step = STEP_S
            self._move_slider(time.monotonic())
        self._around.visible = model is not None and model.rest.shell is not None
        self.at_rest.visible = model is not None and model.motion is not None
        count = 0 if model is None or model.movers is None else model.movers.parts
        offered = (EVERYTHING, STANDS, *(f"{PART} {n + 1}" for n in range(count)))
        if self._parts.options != offered:
            self._parts.options = offered
        self._parts.visible = count > 0
        self._scene_note.content = "  \n".join(f"_{note}_" for note in loaded.notes)
        self._scene_note.visible = bool(loaded.notes)

    def choose(self, has_model: bool) -> None:
        """What stands in the scene at first: more where no picture can be seen."""
        for name, box in self.groups.items():
            box.value = not has_model or name in SHOWN_AT_FIRST

    def say(self, standing: str) -> None:
        """The run's standing, HTML."""
        if self._standing.content != standing:
            self._standing.content = standing

    def note(self, text: str) -> None:
        """A remark on the picture; empty: none."""
        if self._note.content != text:
            self._note.content, self._note.visible = text, bool(text)

    @property
    def alone(self) -> bool:
        """Whether only what is in the box is wanted."""
        return self._around.visible and not self._around.value

    @property
    def shown(self) -> tuple[bool, tuple[int, ...]] | None:
        """Whether what stands is wanted, and which parts of what moves; None: everything."""
        chosen = self._parts.value
        if not self._parts.visible or chosen == EVERYTHING:
            return None
        return (True, ()) if chosen == STANDS else (False, (int(chosen.removeprefix(PART)),))

    def moment(self, now: float) -> float:
        """The time in [0, 1] at a moment of the clock; while it runs the slider follows. For the painter alone."""
        step = SPEEDS[self._speed.value] * (now - self._asked) / self._span_s if self.runs else 0.0
        self._way, self._asked = stepped(self._way, step, self._ping_pong.value), now
        if self._jumps:
            self._way = self._jumps.pop()
        elif (self.runs and now - self._slid > SLIDER_S) or not self._slid:
            self._move_slider(now)
        return place(self._way)

    def run(self, runs: bool) -> None:
        """Let time run, or stand."""
        self._asked, self._slid, self.runs = time.monotonic(), 0.0, runs
        self._play.label = "Pause" if runs else "Play"
        self._play.icon = viser.Icon.PLAYER_PAUSE if runs else viser.Icon.PLAYER_PLAY
        self._changed()

    def _jump(self) -> None:
        self._jumps.append(min(max((self._slider.value - self._t0_s) / self._span_s, 0.0), 1.0))
        if self.runs:
            self.run(False)
        self._changed()

    def _move_slider(self, now: float) -> None:
        at = round(self._t0_s + place(self._way) * self._span_s, 3)
        self._slid, self._slider.value = now, min(max(at, self._slider.min), self._slider.max)
