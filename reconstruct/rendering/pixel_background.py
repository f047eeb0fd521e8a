"""What every pixel of the moving cameras sees outside the box, computed once: the surroundings stand still."""

import torch
from jaxtyping import Int
from torch import Tensor

from devrf.reconstruct.rendering.model import Around, DynamicModel
from devrf.reconstruct.rendering.rays import RaySet


class PixelSurroundings:
    """Looks up the surroundings of pixels; cameras that stand still share them."""

    def __init__(self, model: DynamicModel, rays: RaySet) -> None:
        firsts: dict[tuple[object, ...], int] = {}
        parts: list[Around] = []
        first_of_frame, size = [], 0
        for camera in rays.cameras:
            key = camera.view
            if key not in firsts:
                firsts[key] = size
                parts.append(model.around_camera(camera))
                size += camera.width * camera.height
            first_of_frame.append(firsts[key])
        self.first = torch.tensor(first_of_frame, device=rays.device)
        self.whole = Around(
            *(torch.cat([getattr(p, n) for p in parts]) for n in ("front", "through", "back"))
        )

    def at(self, frame: Int[Tensor, " n"], pixel: Int[Tensor, " n"]) -> Around:
        """Surroundings of given pixels of given pictures."""
        index = self.first[frame] + pixel
        return Around(self.whole.front[index], self.whole.through[index], self.whole.back[index])
