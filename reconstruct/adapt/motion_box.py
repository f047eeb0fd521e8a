"""The box that the subject sweeps while it moves."""

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.adapt.hull import box_of, visual_hull
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import grid_shape

HULL_RESOLUTION, HULL_TIMES, HULL_MARGIN = 40, 12, 1.05


def motion_box(
    scene: Scene, rest: RestModel, frames: tuple[PosedFrame, ...], times: int
) -> Float[Tensor, "2 3"]:
    """The box that the subject sweeps: before a plain background the union of its hulls over time."""
    if scene.background == "shell" or rest.canonical.ndc is not None:
        return rest.canonical.aabb
    cameras: dict[str, list[PosedFrame]] = {}
    for frame in frames:
        cameras.setdefault(frame.camera_name, []).append(frame)
    whole = torch.tensor(scene.aabb, dtype=torch.float32)
    shape = grid_shape(whole, HULL_RESOLUTION)
    swept = torch.zeros(shape, dtype=torch.bool)
    for n in range(0, times, max(1, times // HULL_TIMES)):
        time = n / max(1, times - 1)
        nearest = [min(clip, key=lambda f, t=time: abs((f.time or 0.0) - t)) for clip in cameras.values()]
        swept |= visual_hull(nearest, whole, shape, scene.background, least_seen=1.0)
    box = box_of(swept, whole, HULL_MARGIN)
    if box is None or len(cameras) < 2:
        return rest.canonical.aabb
    return torch.stack(
        [torch.minimum(box[0], rest.canonical.aabb[0]), torch.maximum(box[1], rest.canonical.aabb[1])]
    )
