"""One picture of a film: rendered, and each layer as it is kept.

A picture is a dictionary from the name of a file, `depth/000012.png`, to what the file holds. Films to look at hold
every layer as colour; pictures for other programs (png) hold depth in steps of a stated unit, and motion in numbers.
"""

import time as clock
from collections.abc import Mapping

import numpy as np

from devrf.capture.formats.flow_files import Flow
from devrf.capture.picture_files import to_8_bits
from devrf.capture.scene import load_image
from devrf.pipelines.film.plan import Film
from devrf.pipelines.report.pictures import flow_picture
from devrf.reconstruct.film.layers import DepthScale, backward_flow, depth_colours, depth_steps, planar_depth
from devrf.reconstruct.model import DynamicModel, Layers, render_layers

Picture = Mapping[str, np.ndarray | Flow]
DIVIDER_PX = 4  # white, between a true picture and the rendered one
FULL_FLOW = 0.02  # of the width: motion from one picture to the next that has the fullest colour


class Drawer:
    """Draws a film's pictures.

    Args:
        film: The film.
        model: The trained model.
        depth: How depth is shown.
    Attributes:
        render_s: Seconds spent rendering so far.
        full_flow_px: Motion of the fullest colour.
    """

    def __init__(self, film: Film, model: DynamicModel, depth: DepthScale) -> None:
        self.film, self.model, self.depth = film, model, depth
        self.render_s = 0.0
        self.full_flow_px = FULL_FLOW * film.cameras[0].width

    def files(self, n: int) -> list[str]:
        """Names of a picture's files."""
        names = [f"{layer}/{n:06d}.png" for layer in self.film.layers]
        return names + ([f"flow/{n:06d}.npz"] if self._exact and "flow" in self.film.layers else [])

    def draw(self, n: int) -> Picture:
        """Picture `n` of the film."""
        film, camera, time = self.film, self.film.cameras[n], self.film.times[n]
        begin = clock.perf_counter()
        layers = render_layers(self.model, camera, time)
        self.render_s += clock.perf_counter() - begin
        found: dict[str, np.ndarray | Flow] = {}
        for layer in film.layers:
            name = f"{layer}/{n:06d}.png"
            if layer == "colour":
                found[name] = self._with_true(n, to_8_bits(layers[0]))
            elif layer == "depth":
                depth = planar_depth(camera, layers, self.depth)
                found[name] = (depth_steps if self._exact else depth_colours)(depth, self.depth)
            else:
                flow = self._flow(n, layers)
                found[name] = flow_picture(*flow, self.full_flow_px)
                if self._exact:
                    found[f"flow/{n:06d}.npz"] = flow
        return found

    @property
    def _exact(self) -> bool:
        return self.film.format == "png"

    def _flow(self, n: int, layers: Layers) -> Flow:
        """Of the first picture nothing is known: there is none before it."""
        film = self.film
        before = max(n - 1, 0)
        flow, known = backward_flow(
            self.model, layers, film.cameras[n], film.times[n], film.cameras[before], film.times[before]
        )
        return flow, known & (n > 0)

    def _with_true(self, n: int, rendered: np.ndarray) -> np.ndarray:
        if not self.film.beside:
            return rendered
        frame, height = self.film.beside[n], len(rendered)
        scale = min(1.0, height / frame.camera.height)
        true = load_image(frame, scale, self.film.scene.background)
        true = _as_high(true, height)
        divider = np.full((height, DIVIDER_PX, 3), 255, np.uint8)
        return np.concatenate([true, divider, rendered], axis=1)


def _as_high(picture: np.ndarray, height: int) -> np.ndarray:
    """Rows cut or white ones added: rounded sizes differ by one, smaller pictures are not enlarged."""
    if len(picture) >= height:
        return picture[:height]
    return np.pad(picture, ((0, height - len(picture)), (0, 0), (0, 0)), constant_values=255)
