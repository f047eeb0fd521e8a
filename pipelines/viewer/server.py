"""The viewer: a server of pages, and a thread that looks at the run folder and paints; all visitors share one view.

A small picture comes at once, and larger ones of the same while nothing changes.
"""

import logging
import threading
import time
import warnings
from pathlib import Path

import rich
import torch
import viser

from devrf.capture.camera import Camera
from devrf.capture.photos.picture_files import to_8_bits
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.viewer.controls import Controls, some_of
from devrf.pipelines.viewer.own_address import Address, only_own_pages
from devrf.pipelines.viewer.progressive import FINER, FIRST, at_most, in_time
from devrf.pipelines.viewer.run_status import standing
from devrf.pipelines.viewer.scene_widgets import furnish
from devrf.pipelines.viewer.source import Loaded, RunVersions, load, look
from devrf.pipelines.viewer.views import first_camera, follow, look_through, middle, seen_by
from devrf.pipelines.viewer.visitors import Visitors
from devrf.reconstruct.rendering.model import DynamicModel, render_layers

LOOK_EVERY_S = 1.0  # at the run folder
IDLE_S = 1.0  # longest wait for something to paint
ENDING_S = 1.0  # for a part of a picture
FASTEST_S = 1 / 30  # between two pictures while time runs
MOST_PIXELS = {"cpu": 1280 * 720, "cuda": 1920 * 1080}  # of a picture that is finished
QUALITY_MOVING, QUALITY = 75, 92  # of JPEG

logger = logging.getLogger(__name__)


class Superseded(Exception):
    """Another picture is wanted."""


class Site:
    """Serves one run folder until it is closed.

    Args:
        config: Of the scene.
        run_dir: The run folder; only read.
        device: cpu or cuda.
        at: Where pages are served.
    Attributes:
        loaded: What is shown.
        visitors: Whose pages it shows.
    """

    def __init__(self, config: SceneConfig, run_dir: Path, device: str, at: Address) -> None:
        if device == "cpu":
            torch.set_num_threads(1)  # several wait longer than they work; kernels take all cores
        self._config, self._run_dir, self._device = config, run_dir, device
        self._wanted, self._closed = threading.Event(), threading.Event()
        self._looked = 0.0  # when it was looked at the run folder
        self._wish, self._painted = 1, 0  # pictures asked for; the last that was painted
        self._budget, self._pixels, self._whole = FIRST, 0.0, True  # of it
        self._some: tuple[DynamicModel, str, DynamicModel] | None = None  # of which model, what, and that
        self._groups: dict[str, viser.FrameHandle] = {}
        self.loaded = Loaded()
        self._unreadable: RunVersions | None = None  # what could not be read at the last look
        self._wrong: dict[str, str] = {}  # why it could not, and why the last picture could not be rendered
        rich.get_console().quiet = True  # where viser speaks, whatever it is told
        # visitors may leave at any time
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        with only_own_pages([at.host, *at.names]):
            self.server = viser.ViserServer(host=at.host, port=at.port, label=config.name, verbose=False)
        self.visitors = Visitors(self.server)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.gui.main_panel.dock_right()
        self._controls = Controls(self.server.gui, self._want, self._go_home)
        self._look()
        self._thread = threading.Thread(target=self._work, name="viewer", daemon=True)
        self._thread.start()
        self.server.on_client_connect(self._welcome)

    def close(self) -> bool:
        """End, as soon as the part of a picture is done that is being rendered.

        Returns:
            Whether it is: compiling kernels takes longer, and cannot be broken off.
        """
        # What threads and tasks of visitors meet who are cut off now is nobody's concern.
        threading.excepthook = lambda met: logger.debug("after the end: %s", met.exc_value)
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        self._closed.set()
        self._wanted.set()
        self.server.stop()
        self._thread.join(ENDING_S)
        return not self._thread.is_alive()

    def standing(self) -> str:
        """What is said of the run, HTML."""
        return standing(self._config, self._run_dir, self.loaded, self._wrong)

    def look_through(self, camera: Camera) -> None:
        """Let all pages show what a camera sees."""
        if (scene := self.loaded.scene) is not None:
            self.visitors.turn(
                self.server.get_clients().values(), lambda page: look_through(page, camera, scene)
            )

    def _go_home(self) -> None:
        if self.loaded.scene is not None:
            self.look_through(first_camera(self.loaded.scene))

    def _want(self) -> None:
        for name, group in self._groups.items():
            group.visible = self._controls.groups[name].value
        self._wish += 1
        self._wanted.set()

    def _welcome(self, client: viser.ClientHandle) -> None:
        leader = self.visitors.leading()
        if leader is None or leader is client:
            self._go_home()
        else:
            self.visitors.turn([client], lambda page: follow(page, leader.camera))
        client.camera.on_update(lambda camera: self._moved(client))
        self._looked = 0.0  # the new one waits to be told
        self._want()

    def _moved(self, client: viser.ClientHandle) -> None:
        """Others follow the page that is moved; what they say of themselves meanwhile moves nobody."""
        if self.visitors.lead(client):
            self._want()

    def _work(self) -> None:
        while not self._closed.is_set():
            self._wanted.clear()
            self._look()
            leader, model = self.visitors.leading(), self.loaded.model
            if leader is None or model is None or (self._whole and self._wish == self._painted):
                self._wanted.wait(IDLE_S)
                continue
            try:
                self._paint(model, leader.camera)
            except Superseded:
                continue
            except Exception as error:  # a picture that fails must not end the others
                if not self._closed.is_set():
                    logger.exception("a picture could not be rendered")
                    self._wrong["not rendered"] = str(error) or type(error).__name__
                    self._painted, self._whole, self._looked = self._wish, True, 0.0

    def _paint(self, model: DynamicModel, leader: viser.CameraHandle) -> None:
        """Render the next picture and send it; a larger one of the same is given up when another is wanted."""
        now, wish, chosen = time.monotonic(), self._wish, self._controls.shown.value
        if self._some is None or self._some[:2] != (model, chosen):
            self._some = model, chosen, some_of(model, chosen)
        pages = list(self.server.get_clients().values())
        shapes = [page.camera.image_width / max(1, page.camera.image_height) for page in pages]
        height, fresh = max(2, *(page.camera.image_height for page in pages)), wish != self._painted
        whole = at_most(max(2, round(max(shapes) * height)), height, MOST_PIXELS[self._device])
        pixels = self._budget if fresh else FINER * self._pixels
        camera, finest = seen_by(leader, *at_most(*whole, pixels)), pixels >= whole[0] * whole[1]

        def go_on() -> None:
            self._look()
            if self._closed.is_set() or self.loaded.model is not model or not (fresh or self._wish == wish):
                raise Superseded

        moment = self._controls.moment(now)
        layers = render_layers(self._some[2], camera, moment, between=go_on, roughly=fresh and not finest)
        picture, quality = to_8_bits(layers[0]), QUALITY if finest else QUALITY_MOVING
        for page, shape in zip(pages, shapes, strict=True):  # each sees as much of the sides as it is wide
            seen = middle(picture, shape / max(shapes))
            page.scene.set_background_image(seen, "jpeg", jpeg_quality=quality)
        self._painted, self._pixels, self._whole = wish, pixels, finest
        self._wrong.pop("not rendered", None)
        if fresh:
            self._budget = in_time(self._budget, camera.width * camera.height, time.monotonic() - now)
        if self._controls.runs and moment is not None:
            self._closed.wait(now + FASTEST_S - time.monotonic())
            self._wish += 1

    def _look(self) -> None:
        """Now and then read what is new in the run folder, and tell all visitors."""
        if time.monotonic() - self._looked < LOOK_EVERY_S:
            return
        self._looked = time.monotonic()
        try:
            found = look(self._run_dir)
            if found.scene is not None and found not in (self.loaded.found, self._unreadable):
                self._read(found)
            if self.server.get_clients():
                self._controls.say(self.standing())
        except Exception:  # of one look; the next one may find what it needs
            logger.exception("the run folder could not be looked at")

    def _read(self, found: RunVersions) -> None:
        """Read what was found, or at least where it stands, and show it."""
        before = self.loaded
        self._unreadable = None
        self._wrong.pop("not readable", None)
        try:
            self.loaded = load(self._run_dir, found, self._device)
        except DevrfError as error:
            logger.info("%s", error)
            self._unreadable, self._wrong["not readable"] = found, str(error)
            if before.scene is not None or found == RunVersions(found.scene):
                return
            self.loaded = load(self._run_dir, RunVersions(found.scene), self._device)
        self._controls.renew(self.loaded)
        scene = self.loaded.scene
        if scene is not None and found.scene != before.found.scene:
            self._groups = furnish(self.server.scene, scene, self.look_through)
        if before.scene is None:
            self._go_home()
        self._want()
