"""Training pictures of the moving cameras as movers are trained on them and judged by them: made once, used by all."""

import copy

from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.moving_pixels import changing_pixels
from devrf.reconstruct.sampling.pictures import training


class MovingPictures:
    """The pictures.

    Attributes:
        scene: In the box frame.
        rest: The scene at rest.
        rays: Through their pixels.
        changing: Where they change.
        around: What their pixels see beside the box.
    """

    def __init__(self, scene: Scene, rest: RestModel, device: str) -> None:
        self.scene, self.rest = scene, rest
        self.rays = RaySet(training(scene.dynamic), scene.image_scale, scene.background, device)
        self.changing = changing_pixels(self.rays)
        self.around = PixelSurroundings(DynamicModel(rest), self.rays)

    def at(self, times: Float[Tensor, " f"]) -> "MovingPictures":
        """The same at other times; they are not copied."""
        other = copy.copy(self)
        other.rays = copy.copy(self.rays)
        other.rays.times = times.to(self.rays.times)
        return other
