"""One visitor: a view, a moment, what is to be shown of it, and which picture of that comes next."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import viser

from devrf.capture.camera import Camera
from devrf.capture.picture_files import to_8_bits
from devrf.pipelines.viewer.controls import FROM_REST, NO_ARROWS, Controls
from devrf.pipelines.viewer.furniture import Furniture
from devrf.pipelines.viewer.source import Loaded
from devrf.pipelines.viewer.thumbnails import Thumbnails
from devrf.pipelines.viewer.view import View
from devrf.reconstruct.error_map import confidence_picture
from devrf.reconstruct.film.layers import DepthScale, depth_colours, planar_depth
from devrf.reconstruct.model import render_layers
from devrf.reconstruct.motion_arrows import motion_arrows, next_key
from devrf.reconstruct.refinement import Pace, at_most, at_size, next_size
from devrf.reconstruct.view_pictures import hiding_depth

if TYPE_CHECKING:
    from devrf.reconstruct.confidence import Confidence
    from devrf.reconstruct.model import DynamicModel

FASTEST_S = 1 / 30  # between two pictures while time runs
MOST_PIXELS = {"cpu": 1280 * 720, "cuda": 1920 * 1080}  # of a picture that is finished
QUALITY_MOVING, QUALITY = 75, 92  # of JPEG
BEHIND = {False: "white", True: "black"}  # what is in the box, where it is shown alone; of a dark page
DEPTH_PIXELS = 40_000  # a PNG of more takes longer than the picture
NOTHING_HIDES = 160.0  # depth; what the page can tell ends at 167.77
MOST_ARROWS = 500
LEARNING = "_How sure pictures are has to be learned from the training pictures first: a moment …_"
UNFINISHED = "_How sure a picture is can be told once the training has finished._"
SURENESS = "_White is sure, an expected PSNR of 40 dB or more; black is 10 dB or less._"


class Superseded(Exception):
    """Another picture is wanted."""


class Visit:
    """What one visitor sees, and wants to see.

    Args:
        client: The visitor.
        thumbnails: Where pictures of cameras come from.
        wake: Called when a picture is wanted.
    Attributes:
        controls: The panel.
        gone: Whether the visitor has left.
    """

    def __init__(self, client: viser.ClientHandle, thumbnails: Thumbnails, wake: Callable[[], None]) -> None:
        self._client, self._thumbnails, self._wake = client, thumbnails, wake
        self.gone = False
        self._loaded = Loaded()
        self._furniture: Furniture | None = None
        self._home: View | None = None
        self._alone: tuple[DynamicModel, bool, DynamicModel] | None = None
        self._sure_of: Loaded | None = None  # of what it has been learned how sure pictures are
        self._pace = Pace()
        self._wish, self._painted, self._halvings = 1, 0, 0
        self._next = 0.0  # earliest moment of the next picture while time runs
        self._arrows: tuple[str, float] = (NO_ARROWS, 0.0)
        self.controls = Controls(client, self.want, self._show, self._go_home)
        client.camera.on_update(lambda camera: self._moved())

    def renew(self, loaded: Loaded, standing: str, facts: str, home: View | None) -> None:
        """Show something else from now on."""
        before, self._loaded, self._home = self._loaded, loaded, home
        self.controls.renew(standing, facts, loaded)
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
            for name, visible in self.controls.groups():
                self._furniture.show(name, visible)
        self.want()

    def want(self) -> None:
        """Another picture than the one that is shown."""
        self._wish += 1
        self._wake()

    def _moved(self) -> None:
        if self._furniture is not None:
            self._furniture.seen_from(self._client.camera.position)
        self.want()

    def due(self, now: float) -> bool:
        """Whether there is something to paint."""
        if self._loaded.model is None:
            return False
        return self._wish != self._painted or self._halvings > 0 or (self.plays and now >= self._next)

    def paint(self, confidence: Callable[[], "Confidence"], between: Callable[[], object]) -> None:
        """Render the next picture and send it; a larger one of the same is given up when another is wanted.

        Args:
            confidence: What is known of how sure pictures are, where that is to be shown.
            between: Called between parts of the picture; may raise `Superseded`.
        """
        model, scene, now, wish = self._model(), self._loaded.scene, time.monotonic(), self._wish
        assert scene is not None
        fresh = wish != self._painted or self.plays
        moment = self.controls.moment(now) if scene.dynamic else 0.0
        view = View.of(self._client.camera)
        whole = at_most(view.width, view.height, MOST_PIXELS[model.rest.canonical.density.device.type])
        halvings = self._pace.first(whole[0] * whole[1]) if fresh else next_size(self._halvings)
        camera = view.camera(*at_size(*whole, halvings))

        def go_on() -> None:
            between()
            if self.gone or (not fresh and self._wish != wish):
                raise Superseded

        shown = moment if model.motion is not None and not self.controls.at_rest else None
        try:
            layers = render_layers(model, camera, shown, between=go_on, roughly=fresh and halvings > 0)
            picture = self._picture(layers, camera, shown, confidence)
            between()
            if self.gone:
                raise Superseded
        except Superseded:
            return
        depth = hiding_depth(layers[1], layers[2], camera, NOTHING_HIDES, DEPTH_PIXELS)
        quality = QUALITY if halvings == 0 else QUALITY_MOVING
        self._client.scene.set_background_image(picture, "jpeg", jpeg_quality=quality, depth=depth)
        self._painted, self._halvings, self._next = wish, halvings, now + FASTEST_S
        if fresh:
            self._pace.note(camera.width * camera.height, time.monotonic() - now)
            self._follow(moment)

    def give_up(self, reason: str) -> None:
        """No picture of what is wanted now."""
        self._painted, self._halvings = self._wish, 0
        self.controls.playback.stop(time.monotonic())
        self.controls.note(f"_Not rendered: {reason}_")

    @property
    def plays(self) -> bool:
        """Whether what is to be shown changes by itself."""
        return self.controls.playback.runs and not self.controls.at_rest

    def _model(self) -> "DynamicModel":
        """The model, or what is in its box alone."""
        whole = self._loaded.model
        assert whole is not None
        if not self.controls.alone:
            return whole
        dark = self.controls.dark
        if self._alone is None or self._alone[0] is not whole or self._alone[1] != dark:
            self._alone = whole, dark, whole.alone(BEHIND[dark])
        return self._alone[2]

    def _picture(
        self,
        layers: tuple[np.ndarray, np.ndarray, np.ndarray],
        camera: Camera,
        moment: float | None,
        confidence: Callable[[], "Confidence"],
    ) -> np.ndarray:
        """What is to be shown of a view, bytes."""
        rgb, _, opacity = layers
        layer, note = self.controls.layer, ""
        if layer == "confidence" and not self._loaded.found.finished:
            picture, note = to_8_bits(rgb), UNFINISHED
        elif layer == "confidence":
            if self._sure_of is not self._loaded:
                self.controls.note(LEARNING)
            expected, note = confidence().expected(camera, moment, layers), SURENESS
            self._sure_of = self._loaded
            picture = np.repeat(confidence_picture(expected)[..., None], 3, axis=2)
        elif layer == "depth":
            assert self._loaded.scene is not None
            scale = DepthScale.of([camera], self._loaded.scene.aabb, self._loaded.scene.near, 1.0, False)
            picture = depth_colours(planar_depth(camera, layers, scale), scale)
        elif layer == "opacity":
            picture = to_8_bits(np.repeat(opacity[..., None], 3, axis=2))
        else:
            picture = to_8_bits(rgb)
        self.controls.note(note)
        return picture

    def _follow(self, moment: float) -> None:
        """Let what stands in the scene follow the time."""
        assert self._furniture is not None
        self._furniture.at(moment)
        wanted = (self.controls.arrows, moment)
        if wanted == self._arrows or (self._arrows[0] == NO_ARROWS == wanted[0]):
            return
        self._arrows, model = wanted, self._loaded.model
        if wanted[0] == NO_ARROWS or model is None or model.motion is None:
            self._furniture.arrows(np.zeros((0, 2, 3)))
        elif wanted[0] == FROM_REST:
            self._furniture.arrows(motion_arrows(model, None, moment, MOST_ARROWS))
        else:
            self._furniture.arrows(motion_arrows(model, moment, next_key(model, moment), MOST_ARROWS))

    def _show(self, name: str, visible: bool) -> None:
        if self._furniture is not None:
            self._furniture.show(name, visible)

    def _look_through(self, camera: Camera) -> None:
        assert self._loaded.scene is not None
        self._go_to(View.through(camera, self._loaded.scene.aabb.mean(axis=0)))

    def _go_home(self) -> None:
        if self._home is not None:
            self._go_to(self._home)

    def _go_to(self, view: View) -> None:
        camera = self._client.camera
        with self._client.atomic():
            camera.position = view.position
            camera.look_at = view.look_at
            camera.wxyz = view.wxyz
            camera.fov = view.fov_rad
