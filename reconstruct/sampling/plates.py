"""What fixed cameras show of what stands, as rays to train on: pixels over which nothing ever moved.

The sweep goes round the scene; the fixed cameras look at what is behind it, from where they will be asked for pictures.
Pixels over which anything moved are left out: before and after, they need not show what the sweep shows.
"""

from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import UInt8

from devrf.capture.scene import Scene
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.clean_plate import plate, standing_clips

SHARE = 0.2  # of the rays of an iteration


def plates(scene: Scene, device: str) -> tuple[RaySet | None, dict[str, float]]:
    """Rays of the pixels that never change in fixed training cameras, and their share of each camera's picture.

    Where nothing is seen beside the subject (a plain background) and of cameras that move there are none.
    """
    standing = standing_clips(scene) if scene.background == "shell" else {}
    if not standing:
        return None, {}
    kept: dict[str, np.ndarray] = {}

    def pictures() -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
        for name, clip in standing.items():
            picture, kept[name] = plate(scene, clip)
            yield picture

    rays = RaySet.of_pictures(tuple(c[0] for c in standing.values()), scene.image_scale, pictures(), device)
    rays.keep_only(torch.from_numpy(np.concatenate([mask.reshape(-1) for mask in kept.values()])).to(device))
    shares = {name: round(float(mask.mean()), 4) for name, mask in kept.items()}
    return (rays if any(shares.values()) else None), shares


def draw_with_plates(sweep: RaySet, fixed: RaySet | None, n: int, generator: torch.Generator) -> RayBatch:
    """Draw rays of the sweep and, a share of them, of the fixed cameras' plates."""
    if fixed is None:
        return sweep.draw(n, generator)
    of_fixed = round(SHARE * n)
    return sweep.draw(n - of_fixed, generator).joined(fixed.draw(of_fixed, generator))
