"""The model on a voxel grid: density and colour at a time."""

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8

from devrf.capture.camera import Camera
from devrf.reconstruct.geometry.field import Field
from devrf.reconstruct.ndc import NEAR


def density_and_colour(
    field: Field, cameras: list[Camera]
) -> tuple[Float32[np.ndarray, "X Y Z"], UInt8[np.ndarray, "X Y Z 3"]]:
    """Extinction per unit of the box frame (NDC: along the reference camera's axis), and sRGB; 0 where it is empty.

    Args:
        field: At a time.
        cameras: In the box frame; a colour is the mean of what those see that have the vertex in their picture.
    """
    shape = field.shape
    density, rgb = np.zeros(shape, np.float32), np.zeros((*shape, 3), np.uint8)
    for part, x in field.blocks(shape):
        dense = field.density(x)
        there = dense > 0
        block = torch.zeros(len(x), 3, device=x.device)
        block[there] = mean_colours(field, x[there], cameras)
        if field.canonical.ndc is not None:
            dense = dense * 2 * NEAR / field.to_box(x)[:, 2] ** 2  # dz'/dz
        density[part] = dense.reshape(-1, *shape[1:]).cpu().numpy()
        rgb[part] = (255 * block).round().byte().reshape(-1, *shape[1:], 3).cpu().numpy()
    return density, rgb


def mean_colours(
    field: Field, x: Float[torch.Tensor, "n 3"], cameras: list[Camera]
) -> Float[torch.Tensor, "n 3"]:
    """RGB in [0, 1] of points, the mean over cameras that have them in their picture (over all, where none has)."""
    box = field.to_box(x)
    points = box.cpu().numpy().astype(np.float64)
    seen = np.zeros((len(cameras), len(points)), bool)
    for n, camera in enumerate(cameras):
        pixel = np.nan_to_num(camera.project(points), nan=-1.0)
        seen[n] = np.all((pixel >= 0) & (pixel < [camera.width, camera.height]), axis=-1)
    seen[:, ~seen.any(0)] = True
    total = torch.zeros_like(x)
    for rows, camera in zip(torch.from_numpy(seen).to(x.device), cameras, strict=True):
        centre = torch.from_numpy(camera.centre.astype(np.float32)).to(x)
        total[rows] += field.colours(x[rows], torch.nn.functional.normalize(box[rows] - centre, dim=1))
    mean = total / torch.from_numpy(seen.sum(0).astype(np.float32)).to(x)[:, None]
    return (mean * field.brightness(x)).clamp(max=1)
