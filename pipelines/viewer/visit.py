"""One visitor: a view, a moment, what is to be shown of it, and which picture of that comes next."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import viser
from jaxtyping import Float32

from devrf.capture.camera import Camera
from devrf.capture.picture_files import to_8_bits
from devrf.pipelines.viewer.controls import Controls
from devrf.pipelines.viewer.furniture import Furniture, Thumbnails
from devrf.pipelines.viewer.source import Loaded
from devrf.pipelines.viewer.view import first_camera, look_through, seen_by
from devrf.reconstruct.film.layers import DepthScale, depth_colours, planar_depth
from devrf.reconstruct.model import Layers, render_layers
from devrf.reconstruct.refinement import FINER, FIRST, at_most, in_time

if TYPE_CHECKING:
    from devrf.reconstruct.model import DynamicModel

FASTEST_S = 1 / 30  # between two pictures while time runs
MOST_PIXELS = {"cpu": 1280 * 720, "cuda": 1920 * 1080}  # of a picture that is finished
QUALITY_MOVING, QUALITY = 75, 92  # of JPEG
BEHIND = "white"  # what is in the box, where it is shown alone
DEPTH_PIXELS = 40_000  # a PNG of more takes longer than the picture
NOTHING_HIDES = 160.0  # depth; what the page can tell ends at 167.77
BOX_FRAME = DepthScale(near=0.0, far=NOTHING_HIDES, unit=1e-6, world_per_box=1.0)


class Superseded(Exception):
    """Another picture is wanted."""


class Visit:
    """What one visitor sees, and wants to see.

    Args:
        client: The visitor.
        thumbnails: Where pictures of cameras come from.
        wake: Called when a picture is wanted.
        in_loop: Calls something where the page's messages are read, in between.
    Attributes:
        controls: The panel.
        gone: Whether the visitor has left.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        thumbnails: Thumbnails,
        wake: Callable[[], None],
        in_loop: Callable[[Callable[[], None]], object],
    ) -> None:
        self._client, self._thumbnails, self._wake, self._in_loop = client, thumbnails, wake, in_loop
        self.gone = False
        self._loaded = Loaded()
        self._furniture: Furniture | None = None
        self._some: tuple[DynamicModel, object, DynamicModel] | None = None  # of which model, and what of it
        self._budget = FIRST  # pixels that are there in time
        self._wish, self._painted, self._whole, self._pixels = 1, 0, True, 0.0
        self._next = 0.0  # earliest moment of the next picture while time runs
        self.controls = Controls(client, self.want, self._show, self._go_home)
        client.camera.on_update(lambda camera: self._moved())

    def renew(self, loaded: Loaded, standing: str) -> None:
        """Say how the run stands, and show something else from now on where there is."""
        self.controls.say(standing)
        before, self._loaded = self._loaded, loaded
        if loaded is before:
            return
        self.controls.renew(loaded)
        if loaded.scene is not None and loaded.found.scene != before.found.scene:
            if self._furniture is not None:
                self._client.scene.reset()
            self._furniture = Furniture(self._client, loaded, self._thumbnails, self._look_through)
            self._furniture.seen_from(self._client.camera.position)
            if before.scene is None:
                self._go_home()
        if self._furniture is not None:
            if (loaded.model is None) != (before.model is None) or before.scene is None:
                self.controls.choose(loaded.model is not None)
            for name, box in self.controls.groups.items():
                self._furniture.show(name, box.value)
        self.want()

    def want(self) -> None:
        """Another picture than the one that is shown."""
        self._wish += 1
        self._wake()

    def due(self, now: float) -> bool:
        """Whether there is something to paint."""
        if self._loaded.model is None:
            return False
        return self._wish != self._painted or not self._whole or (self.plays and now >= self._next)

    def paint(self, between: Callable[[], object]) -> None:
        """Render the next picture and send it; a larger one of the same is given up when another is wanted.

        Args:
            between: Called between parts of the picture; may raise `Superseded`.
        """
        model, scene, now, wish = self._model(), self._loaded.scene, time.monotonic(), self._wish
        assert scene is not None
        fresh = wish != self._painted or self.plays
        moment = self.controls.moment(now) if scene.dynamic else 0.0
        page, most = self._client.camera, MOST_PIXELS[model.rest.canonical.density.device.type]
        whole = at_most(max(2, page.image_width), max(2, page.image_height), most)
        pixels = self._budget if fresh else FINER * self._pixels
        camera = seen_by(page, *at_most(*whole, pixels))

        def go_on() -> None:
            between()
            if self.gone or (not fresh and self._wish != wish):
                raise Superseded

        shown = moment if model.motion is not None and not self.controls.at_rest.value else None
        rough = fresh and pixels < whole[0] * whole[1]
        try:
            layers = render_layers(model, camera, shown, between=go_on, roughly=rough)
            picture = self._picture(layers, camera)
            go_on()
        except Superseded:
            return
        self._whole, self._pixels = pixels >= whole[0] * whole[1], pixels
        quality = QUALITY if self._whole else QUALITY_MOVING
        self._client.scene.set_background_image(
            picture, "jpeg", jpeg_quality=quality, depth=hiding_depth(camera, layers)
        )
        self._painted, self._next = wish, now + FASTEST_S
        if fresh:
            self._budget = in_time(self._budget, camera.width * camera.height, time.monotonic() - now)
            assert self._furniture is not None
            self._furniture.at(moment)

    def give_up(self, reason: str) -> None:
        """No picture of what is wanted now."""
        self.controls.run(False)
        self._painted, self._whole = self._wish, True
        self.controls.note(f"_Not rendered: {reason}_")

    @property
    def plays(self) -> bool:
        """Whether what is to be shown changes by itself."""
        return self.controls.runs and not self.controls.at_rest.value

    def _model(self) -> "DynamicModel":
        """The model, or some of it alone; without what stands, nobody knows what surroundings look like behind it."""
        whole, chosen = self._loaded.model, (self.controls.alone, self.controls.shown)
        assert whole is not None
        if chosen == (False, None):
            return whole
        if self._some is None or self._some[0] is not whole or self._some[1] != chosen:
            alone, shown = chosen
            some = whole if shown is None else whole.showing(*shown)
            bare = alone or (shown is not None and not shown[0])
            self._some = whole, chosen, some.alone(BEHIND) if bare else some
        return self._some[2]

    def _picture(self, layers: Layers, camera: Camera) -> np.ndarray:
        """What is to be shown of a view, bytes."""
        rgb, _, opacity = layers
        layer = self.controls.layer.value
        picture = to_8_bits(rgb)
        if layer == "depth":
            scene = self._loaded.scene
            assert scene is not None
            scale = DepthScale.of([camera], scene.aabb, scene.near, 1.0, metric=False)
            picture = depth_colours(planar_depth(camera, layers, scale), scale)
        elif layer == "opacity":
            picture = to_8_bits(np.repeat(opacity[..., None], 3, axis=2))
        self.controls.note("")
        return picture

    def _moved(self) -> None:
        if self._furniture is not None:
            self._furniture.seen_from(self._client.camera.position)
        self.want()

    def _show(self, name: str, visible: bool) -> None:
        if self._furniture is not None:
            self._furniture.show(name, visible)

    def _look_through(self, camera: Camera) -> None:
        scene = self._loaded.scene
        assert scene is not None

        def look() -> None:
            with self._client.atomic():
                look_through(self._client.camera, camera, scene)

        self._in_loop(look)

    def _go_home(self) -> None:
        if self._loaded.scene is not None:
            self._look_through(first_camera(self._loaded.scene))


def hiding_depth(camera: Camera, layers: Layers) -> Float32[np.ndarray, "hs ws"]:
    """Depth along the camera's axis of what hides things behind it, on every n-th pixel."""
    depth = planar_depth(camera, layers, BOX_FRAME)
    step = max(1, int(np.ceil(np.sqrt(depth.size / DEPTH_PIXELS))))
    rows, columns = (slice(n % step // 2 + step // 2, None, step) for n in depth.shape)
    return np.where(depth[rows, columns] > 0, depth[rows, columns], NOTHING_HIDES).astype(np.float32)
