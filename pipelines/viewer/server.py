"""The viewer: a server of pages, and a thread that looks at the run folder and paints; all visitors share one view.

A small picture comes at once, and larger ones of the same while nothing changes.
"""

import logging
import threading
import time
import warnings
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import rich
import torch
import viser
from jaxtyping import Float32
from viser.transforms import SO3

from devrf.capture.camera import Camera
from devrf.capture.formats.colmap.colmap_poses import quat_wxyz
from devrf.capture.photos.picture_files import to_8_bits
from devrf.capture.scene import Scene
from devrf.capture.system.errors import DevrfError
from devrf.pipelines.config.scene import SceneConfig
from devrf.pipelines.viewer.controls import Controls, some_of
from devrf.pipelines.viewer.own_address import only_own_pages
from devrf.pipelines.viewer.progressive import FINER, FIRST, at_most, in_time
from devrf.pipelines.viewer.run_status import standing
from devrf.pipelines.viewer.scene_widgets import furnish
from devrf.pipelines.viewer.source import Found, Loaded, load, look
from devrf.reconstruct.film.depth_layer import DepthScale, planar_depth
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import orbit
from devrf.reconstruct.rendering.model import DynamicModel, Layers, render_layers

LOOK_EVERY_S = 1.0  # at the run folder
IDLE_S = 1.0  # longest wait for something to paint
ENDING_S = 1.0  # for a part of a picture
CHUNK_CPU = 1 << 12  # rays between two looks at what is wanted
LEAD_S = 1.0  # for which a page that was moved has the view: the others say where they are with some delay
BACK = 1.15  # times as far away as the cameras is the first view, or the room is not seen
FASTEST_S = 1 / 30  # between two pictures while time runs
MOST_PIXELS = {"cpu": 1280 * 720, "cuda": 1920 * 1080}  # of a picture that is finished
QUALITY_MOVING, QUALITY = 75, 92  # of JPEG
DEPTH_PIXELS = 40_000  # a PNG of more takes longer than the picture
NOTHING_HIDES = 160.0  # depth; what the page can tell ends at 167.77
BOX_FRAME = DepthScale(near=0.0, far=NOTHING_HIDES, unit=1e-6, world_per_box=1.0)

logger = logging.getLogger(__name__)


class Superseded(Exception):
    """Another picture is wanted."""


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
        leader: The visitor whose page was moved last; None where there is none.
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
        if device == "cpu":
            torch.set_num_threads(
                1
            )  # several wait for each other longer than they work; kernels take all cores
        self._config, self._run_dir, self._device = config, run_dir, device
        self._wanted, self._closed = threading.Event(), threading.Event()
        self.leader: viser.ClientHandle | None = None
        self._led = 0.0  # when its page was moved
        self._looked = 0.0  # when the run folder was looked at
        self._wish, self._painted = 1, 0  # pictures asked for; the last that was painted
        self._budget, self._pixels, self._whole = FIRST, 0.0, True  # of it
        self._some: tuple[DynamicModel, str, DynamicModel] | None = None  # of which model, what, and that
        self._failed = ""  # why the last picture could not be rendered
        self._groups: dict[str, viser.FrameHandle] = {}
        self.loaded = Loaded()
        self._unreadable: tuple[Found, str] | None = None  # what could not be read at the last look, and why
        rich.get_console().quiet = True  # where viser speaks, whatever it is told
        # visitors may leave at any time
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        with only_own_pages(names):
            self.server = viser.ViserServer(host=host, port=port, label=config.name, verbose=False)
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
        why = "" if self._unreadable is None else self._unreadable[1]
        return standing(self._config, self._run_dir, self.loaded, why)

    def look_through(self, camera: Camera) -> None:
        """Let all pages show what a camera sees."""
        if (scene := self.loaded.scene) is not None:
            self._turn(self.server.get_clients().values(), lambda page: look_through(page, camera, scene))

    def _go_home(self) -> None:
        if self.loaded.scene is not None:
            self.look_through(first_camera(self.loaded.scene))

    def _turn(self, pages: Iterable[viser.ClientHandle], turn: Callable[[viser.CameraHandle], None]) -> None:
        """Turn pages in the server's event loop, where their messages are read.

        What is set of a page depends on what was set before: nothing that it says of itself may come between.
        """

        def turned() -> None:
            for page in pages:
                with page.atomic():
                    turn(page.camera)

        self.server.get_event_loop().call_soon_threadsafe(turned)

    def _want(self) -> None:
        for name, group in self._groups.items():
            group.visible = self._controls.groups[name].value
        self._wish += 1
        self._wanted.set()

    def _welcome(self, client: viser.ClientHandle) -> None:
        leader = self._leading()
        if leader is None or leader is client:
            self._go_home()
        else:
            self._turn([client], lambda page: follow(page, leader.camera))
        client.camera.on_update(lambda camera: self._moved(client))
        self._looked = 0.0  # the new one waits to be told
        self._want()

    def _moved(self, client: viser.ClientHandle) -> None:
        """Others follow the page that is moved; what they say of themselves meanwhile moves nobody."""
        now = time.monotonic()
        if self._leading() is not client and now - self._led < LEAD_S:
            return
        self.leader, self._led = client, now
        others = [page for page in self.server.get_clients().values() if page is not client]
        self._turn(others, lambda page: follow(page, client.camera))
        self._want()

    def _leading(self) -> viser.ClientHandle | None:
        """Who has the view: if that visitor has left, another."""
        clients = self.server.get_clients()
        if self.leader is None or self.leader.client_id not in clients:
            self.leader = next(iter(clients.values()), None)
        return self.leader

    def _work(self) -> None:
        while not self._closed.is_set():
            self._wanted.clear()
            self._look()
            leader, model = self._leading(), self.loaded.model
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
                    self._failed = f"_Not rendered: {error or type(error).__name__}_"
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
        picture, depth = to_8_bits(layers[0]), hiding_depth(camera, layers)
        for page, shape in zip(pages, shapes, strict=True):  # each sees as much of the sides as it is wide
            seen, hidden = (middle(of, shape / max(shapes)) for of in (picture, depth))
            quality = QUALITY if finest else QUALITY_MOVING
            page.scene.set_background_image(seen, "jpeg", jpeg_quality=quality, depth=hidden)
        self._painted, self._pixels, self._whole, self._failed = wish, pixels, finest, ""
        if fresh:
            self._budget = in_time(self._budget, camera.width * camera.height, time.monotonic() - now)
        if self._controls.runs and moment is not None:
            self._closed.wait(now + FASTEST_S - time.monotonic())
            self._wish += 1

    def _look(self) -> None:
        """Now and then look for what is new in the run folder, and tell all visitors."""
        if time.monotonic() - self._looked < LOOK_EVERY_S:
            return
        self._looked, before = time.monotonic(), self.loaded
        try:
            if self._refresh():
                scene = self.loaded.scene
                self._controls.renew(self.loaded)
                if scene is not None and self.loaded.found.scene != before.found.scene:
                    self._groups = furnish(self.server.scene, scene, self.look_through)
                if before.scene is None:
                    self._go_home()
                self._want()
            if self.server.get_clients():
                self._controls.say(self.standing(), self._failed)
        except Exception:  # of one look; the next one may find what it needs
            logger.exception("the run folder could not be looked at")

    def _refresh(self) -> bool:
        """Read what is new in the run folder; whether anything is."""
        found = look(self._run_dir)
        if found == self.loaded.found or (self._unreadable is not None and found == self._unreadable[0]):
            return False
        try:
            loaded, self._unreadable = load(self._run_dir, found, self._device, self.loaded), None
        except DevrfError as error:
            logger.info("%s", error)
            self._unreadable = found, str(error)
            if self.loaded.scene is not None or found.scene is None or found == Found(found.scene):
                return False
            # at least where it stands
            loaded = load(self._run_dir, Found(found.scene), self._device, self.loaded)
        if loaded.model is not None and self._device == "cpu":
            loaded.model.chunk = min(loaded.model.chunk, CHUNK_CPU)
        self.loaded = loaded
        return True


def first_camera(scene: Scene) -> Camera:
    """The middle of what the cameras saw, a little farther away; in the box frame."""
    cameras = film_cameras(scene)
    camera = orbit(cameras, scene.aabb, 4, film_lens(cameras))[1]  # the middle of a swing
    R, centre = camera.cam_from_world[:, :3], camera.centre
    back = centre - (BACK - 1) * max(float(R[2] @ (scene.aabb.mean(axis=0) - centre)), 0.1) * R[2]
    return replace(camera, cam_from_world=np.column_stack([R, -R @ back]))


def seen_by(page: viser.CameraHandle, width: int, height: int) -> Camera:
    """What a page shows, as a camera of the model whose pictures have this size: no distortion, square pixels."""
    R = SO3(page.wxyz).as_matrix()
    f = height / 2 / np.tan(page.fov / 2)
    K = np.array([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1.0]])
    return Camera(width, height, K, np.column_stack([R.T, -R.T @ page.position]))


def look_through(page: viser.CameraHandle, camera: Camera, scene: Scene) -> None:
    """Let a page show what a camera sees, turned about a point before it that is as far away as the scene's middle."""
    axis = camera.cam_from_world[2, :3]
    away = max(float(axis @ (scene.aabb.mean(axis=0) - camera.centre)), 0.1)
    up = -np.mean([other.cam_from_world[1, :3] for other in film_cameras(scene)], axis=0)
    page.fov = 2 * float(np.arctan(camera.height / 2 / camera.K[1, 1]))
    page.position, page.look_at = camera.centre, camera.centre + away * axis
    page.up_direction = up / np.linalg.norm(up)
    page.wxyz = np.array(quat_wxyz(camera.cam_from_world[:, :3].T))


def follow(page: viser.CameraHandle, leader: viser.CameraHandle) -> None:
    """Let a page look from where another one does."""
    page.fov, page.position, page.look_at = leader.fov, leader.position, leader.look_at
    page.up_direction, page.wxyz = leader.up_direction, leader.wxyz


def middle(picture: np.ndarray, share: float) -> np.ndarray:
    """The middle of a picture [h, w, ...] with a share of its width."""
    left = (picture.shape[1] - max(1, round(share * picture.shape[1]))) // 2
    return np.ascontiguousarray(picture[:, left : picture.shape[1] - left])


def hiding_depth(camera: Camera, layers: Layers) -> Float32[np.ndarray, "hs ws"]:
    """Depth along the camera's axis of what hides things behind it, on every n-th pixel."""
    depth = planar_depth(camera, layers, BOX_FRAME)
    step = max(1, int(np.ceil(np.sqrt(depth.size / DEPTH_PIXELS))))
    rows, columns = (slice(n % step // 2 + step // 2, None, step) for n in depth.shape)
    return np.where(depth[rows, columns] > 0, depth[rows, columns], NOTHING_HIDES).astype(np.float32)
