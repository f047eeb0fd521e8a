"""The viewer: a server of pages, and a thread that looks at the run folder and paints for all visitors in turn."""

import logging
import threading
import time
import warnings
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

import rich
import torch
import viser

from devrf.capture.errors import DevrfError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.viewer.furniture import Thumbnails
from devrf.pipelines.viewer.own_address import only_own_pages
from devrf.pipelines.viewer.source import Found, Loaded, load, look
from devrf.pipelines.viewer.standing import standing
from devrf.pipelines.viewer.view import first_camera, look_through
from devrf.pipelines.viewer.visit import Superseded, Visit
from devrf.reconstruct.model import render_layers

LOOK_EVERY_S = 1.0  # at the run folder
IDLE_S = 1.0  # longest wait for something to paint ...
PLAYING_S = 1 / 120  # ... and where time runs
ENDING_S = 1.0  # for a part of a picture
CHUNK_CPU = 1 << 12  # rays between two looks at what is wanted
TRY_SCALE = 0.1  # of the picture with which kernels are made ready

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
        names: By which browsers may ask for them, besides this machine's own.
    Attributes:
        loaded: What is shown.
    """

    def __init__(
        self,
        config: SceneConfig,
        run_dir: Path,
        device: str,
        host: str,
        port: int,
        names: Collection[str] = (),
    ) -> None:
        self._config, self._run_dir, self._device = config, run_dir, device
        self._wanted, self._closed = threading.Event(), threading.Event()
        self._visits: dict[int, Visit] = {}
        self._last = 0  # visitor that was painted for
        self._looked = 0.0  # when the run folder was looked at
        self._thumbnails = Thumbnails()
        self.loaded = Loaded()
        self._unreadable: tuple[Found, str] | None = None  # what could not be read at the last look, and why
        self._refresh()
        rich.get_console().quiet = True  # where viser speaks, whatever it is told
        # visitors may leave at any time
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        with only_own_pages(names):
            self.server = viser.ViserServer(host=host, port=port, label=config.name, verbose=False)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self._set_first_view()
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._farewell)

    def close(self) -> bool:
        """End, as soon as the part of a picture is done that is being rendered.

        Returns:
            Whether it is: compiling kernels and learning how sure pictures are take longer, and cannot be broken off.
        """
        # What threads and tasks of visitors meet who are cut off now is nobody's concern.
        threading.excepthook = lambda met: logger.debug("after the end: %s", met.exc_value)
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        self._closed.set()
        self._wanted.set()
        self._thumbnails.end()
        self.server.stop()
        self._thread.join(ENDING_S)
        return not self._thread.is_alive()

    def standing(self) -> str:
        """What is said of the run, HTML."""
        why = "" if self._unreadable is None else self._unreadable[1]
        return standing(self._config, self._run_dir, self.loaded, why)

    def _welcome(self, client: viser.ClientHandle) -> None:
        self._visits[client.client_id] = Visit(
            client, self._thumbnails, self._wanted.set, self.server.get_event_loop().call_soon_threadsafe
        )
        self._looked = 0.0  # the new one waits to be told
        self._wanted.set()

    def _farewell(self, client: viser.ClientHandle) -> None:
        visit = self._visits.pop(client.client_id, None)
        if visit is not None:
            visit.gone = True

    def _work(self) -> None:
        self._make_ready()
        while not self._closed.is_set():
            self._wanted.clear()
            self._look()
            visit = self._next()
            if visit is None:
                plays = any(visit.plays for visit in list(self._visits.values()))
                self._wanted.wait(PLAYING_S if plays else IDLE_S)
                continue
            try:
                visit.paint(self._go_on)
            except Exception as error:  # a picture that fails must not end the others
                if not self._closed.is_set():
                    logger.exception("a picture could not be rendered")
                    visit.give_up(str(error) or type(error).__name__)

    def _go_on(self) -> None:
        """Between two parts of a picture: end it where it is not wanted any more."""
        before = self.loaded
        self._look()
        if self._closed.is_set() or self.loaded is not before:
            raise Superseded

    def _look(self) -> None:
        """Now and then look for what is new in the run folder, and tell all visitors."""
        if time.monotonic() - self._looked < LOOK_EVERY_S:
            return
        self._looked = time.monotonic()
        try:
            scene = self.loaded.found.scene
            if self._refresh() and self.loaded.found.scene != scene:
                self._set_first_view()
            visits = list(self._visits.values())
            said = self.standing() if visits else ""
            for visit in visits:
                visit.renew(self.loaded, said)
        except Exception:  # of one look; the next one may find what it needs
            logger.exception("the run folder could not be looked at")

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

    def _set_first_view(self) -> None:
        scene = self.loaded.scene
        if scene is not None:
            look_through(self.server.initial_camera, first_camera(scene), scene)

    def _next(self) -> Visit | None:
        """Whose turn it is of those who wait for a picture."""
        now = time.monotonic()
        waiting = sorted(number for number, visit in list(self._visits.items()) if visit.due(now))
        if not waiting:
            return None
        self._last = next((number for number in waiting if number > self._last), waiting[0])
        return self._visits.get(self._last)

    def _make_ready(self) -> None:
        """Load and compile kernels before the first visitor waits for them."""
        loaded = self.loaded
        if loaded.model is not None and loaded.scene is not None:
            camera = first_camera(loaded.scene).scaled(TRY_SCALE)
            with suppress(Superseded):
                moment = None if loaded.model.motion is None else 0.5
                render_layers(loaded.model, camera, moment, between=self._go_on)
