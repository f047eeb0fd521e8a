"""The viewer: a server of pages, a thread that paints for all visitors in turn, one that looks at the run folder."""

import logging
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import rich
import torch
import viser

from devrf.capture.errors import DevrfError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.viewer.controls import themed
from devrf.pipelines.viewer.source import Found, Loaded, load, look
from devrf.pipelines.viewer.standing import facts, standing
from devrf.pipelines.viewer.thumbnails import Thumbnails
from devrf.pipelines.viewer.view import View, up_of
from devrf.pipelines.viewer.visit import Superseded, Visit
from devrf.reconstruct.model import render_layers

if TYPE_CHECKING:
    from devrf.reconstruct.confidence import Confidence

LOOK_EVERY_S = 1.0  # at the run folder
IDLE_S = 1.0  # longest wait for something to paint ...
PLAYING_S = 1 / 120  # ... and where time runs
ENDING_S = 12.0  # for a thread that learns how sure pictures are; the command's parent waits for 15
CHUNK_CPU = 1 << 12  # rays between two looks at what is wanted
TRY_PX = 32  # sides of the picture with which kernels are made ready

logger = logging.getLogger(__name__)


def settle(device: str) -> None:
    """Let small tensors be worked on by one thread: several wait for each other longer than they work.

    Kernels still take all cores.
    """
    if device == "cpu":
        torch.set_num_threads(1)


class Site:
    """Serves one run folder until it is closed.

    Args:
        config: Of the scene.
        run_dir: The run folder; only read.
        device: cpu or cuda.
        host, port: Where pages are served.
    """

    def __init__(
        self,
        config: SceneConfig,
        run_dir: Path,
        device: str,
        host: str,
        port: int,
    ) -> None:
        self._config, self._run_dir, self._device = config, run_dir, device
        self._changed, self._closed = threading.Condition(), threading.Event()
        self._visits: dict[int, Visit] = {}
        self._news_told = threading.Lock()  # held while visitors are told what is new
        self._last = 0  # visitor that was painted for
        self._thumbnails = Thumbnails()
        self._confidence: tuple[Loaded, Confidence] | None = None
        self.loaded = Loaded()
        self._unreadable: tuple[Found, str] | None = None  # what could not be read at the last look, and why
        self._refresh()
        rich.get_console().quiet = True  # where viser speaks, whatever it is told
        warnings.filterwarnings(
            "ignore", "Queued a .* on a closed connection"
        )  # visitors may leave at any time
        self.server = viser.ViserServer(host=host, port=port, label=config.name, verbose=False)
        themed(self.server.gui, dark=False)
        self.server.gui.main_panel.dock_right()
        self._set_first_view()
        self._threads = [
            threading.Thread(target=work, name=work.__name__, daemon=True)
            for work in (self._paint, self._watch)
        ]
        for thread in self._threads:
            thread.start()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._farewell)

    def close(self) -> None:
        """End, as soon as the part of a picture is done that is being rendered."""
        self._closed.set()
        self._wake()
        self._thumbnails.end()
        self.server.stop()
        for thread in self._threads:  # Python must not end while one of them is in native code
            thread.join(ENDING_S)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _welcome(self, client: viser.ClientHandle) -> None:
        visit = Visit(client, self._thumbnails, self._wake)
        with self._news_told:
            visit.renew(*self._news())
            self._visits[client.client_id] = visit
        self._wake()

    def _farewell(self, client: viser.ClientHandle) -> None:
        visit = self._visits.pop(client.client_id, None)
        if visit is not None:
            visit.gone = True

    def _news(self) -> tuple[Loaded, str, str, View | None]:
        loaded = self.loaded
        home = View.first(loaded.scene) if loaded.scene is not None else None
        return loaded, self._standing(), facts(self._run_dir, loaded), home

    def _standing(self) -> str:
        why = "" if self._unreadable is None else self._unreadable[1]
        return standing(self._config, self._run_dir, self.loaded, why)

    def _set_first_view(self) -> None:
        scene = self.loaded.scene
        if scene is None:
            return
        home, first = View.first(scene), self.server.initial_camera
        self.server.scene.set_up_direction(up_of(scene))
        first.position, first.look_at, first.fov = home.position, home.look_at, home.fov_rad

    def _refresh(self) -> bool:
        """Read what is new in the run folder; whether anything is."""
        found = look(self._run_dir)
        if found == self.loaded.found or (self._unreadable is not None and found == self._unreadable[0]):
            return False
        try:
            loaded = load(self._run_dir, found, self._device, self.loaded)
        except DevrfError as error:
            logger.info("%s", error)
            self._unreadable = found, str(error)
            if self.loaded.scene is not None or found.scene is None or found == Found(found.scene):
                return False
            # at least where it stands
            loaded = load(self._run_dir, Found(found.scene), self._device, self.loaded)
        else:
            self._unreadable = None
        if loaded.model is not None and self._device == "cpu":
            loaded.model.chunk = min(loaded.model.chunk, CHUNK_CPU)
        self.loaded = loaded
        return True

    def _watch(self) -> None:
        while not self._closed.wait(LOOK_EVERY_S):
            try:
                with self._news_told:
                    self._tell_news()
            except Exception:  # of one look; the next one may find what it needs
                logger.exception("the run folder could not be looked at")

    def _tell_news(self) -> None:
        """Tell all visitors what is new in the run folder."""
        scene, visits = self.loaded.found.scene, list(self._visits.values())
        if self._refresh():
            if self.loaded.found.scene != scene:
                self._set_first_view()
            news = self._news()
            for visit in visits:
                visit.renew(*news)
        elif visits:
            said = self._standing()
            for visit in visits:
                visit.controls.say(said)

    def _paint(self) -> None:
        self._make_ready()
        while not self._closed.is_set():
            with self._changed:
                visit = self._next()
                if visit is None:
                    plays = any(visit.plays for visit in self._visits.values())
                    self._changed.wait(PLAYING_S if plays else IDLE_S)
                    continue
            try:
                visit.paint(self._known, self._go_on)
            except Exception as error:  # a picture that fails must not end the others
                if self._closed.is_set():
                    return
                logger.exception("a picture could not be rendered")
                visit.give_up(str(error) or type(error).__name__)

    def _next(self) -> Visit | None:
        """Whose turn it is of those who wait for a picture."""
        now = time.monotonic()
        waiting = sorted(number for number, visit in list(self._visits.items()) if visit.due(now))
        if not waiting:
            return None
        self._last = next((number for number in waiting if number > self._last), waiting[0])
        return self._visits.get(self._last)

    def _known(self) -> "Confidence":
        """What is known of how sure pictures are; learned when it is asked for."""
        from devrf.reconstruct.confidence import Confidence

        loaded = self.loaded
        if self._confidence is None or self._confidence[0] is not loaded:
            assert loaded.scene is not None and loaded.model is not None
            self._confidence = loaded, Confidence(loaded.scene, loaded.model)
        return self._confidence[1]

    def _make_ready(self) -> None:
        """Load and compile kernels before the first visitor waits for them."""
        loaded = self.loaded
        if loaded.model is not None and loaded.scene is not None:
            camera = View.first(loaded.scene).camera(TRY_PX, TRY_PX)
            with suppress(Superseded):
                moment = None if loaded.model.motion is None else 0.5
                render_layers(loaded.model, camera, moment, between=self._go_on)

    def _go_on(self) -> None:
        if self._closed.is_set():
            raise Superseded
