"""Pictures of what stands by fixed cameras: a median over time, and which of its pixels never changed.

The sweep goes round the scene; the fixed cameras look at what is behind it, from where they will be asked for pictures.
Pixels over which anything ever moved are left out: before and after, they need not show what the sweep shows.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from scipy.ndimage import binary_opening, maximum_filter

from devrf.capture.scene import PosedFrame, Scene, load_image
from devrf.reconstruct.pictures import spread
from devrf.reconstruct.rays import RayBatch, RaySet

MOST_PICTURES = 61
FEWEST_PICTURES = 5
SPREAD, SPREAD_LEVELS = (
    2.2,
    6,
)  # from 5 to 95 %: as many times that of half of the pixels, or so many levels more, is motion
REACH_PX = 9  # side of the square by which what moves is grown
SHARE = 0.2  # of the rays of an iteration


def plates(scene: Scene, device: str) -> tuple[RaySet | None, dict[str, float]]:
    """Rays of the pixels that never change in fixed training cameras, and their share of each camera's picture.

    Where nothing is seen beside the subject (a plain background) and of cameras that move there are none.
    """
    clips: dict[str, list[PosedFrame]] = defaultdict(list)
    for frame in scene.dynamic if scene.background == "shell" else ():
        if frame.split == "train":
            clips[frame.camera_name].append(frame)
    standing = {name: clip for name, clip in clips.items() if len(clip) >= FEWEST_PICTURES and stands(clip)}
    if not standing:
        return None, {}
    kept: dict[str, np.ndarray] = {}

    def pictures() -> Iterator[UInt8[np.ndarray, "_ _ 3"]]:
        for name, clip in standing.items():
            few = spread(clip, MOST_PICTURES)
            picture, kept[name] = plate(
                np.stack([load_image(f, scene.image_scale, scene.background) for f in few])
            )
            yield picture

    rays = RaySet.of_pictures(tuple(c[0] for c in standing.values()), scene.image_scale, pictures(), device)
    rays.keep_only(torch.from_numpy(np.concatenate([kept[name].reshape(-1) for name in standing])).to(device))
    shares = {name: round(float(mask.mean()), 4) for name, mask in kept.items()}
    return (rays if any(shares.values()) else None), shares


def plate(
    pictures: UInt8[np.ndarray, "n h w 3"], share: float = 0.9
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """The median of pictures of a camera that stands, and where this share of them differ by no more than noise."""
    order = [round(q * (len(pictures) - 1)) for q in (0.5 - share / 2, 0.5, 0.5 + share / 2)]
    low, middle, high = np.partition(pictures, order, axis=0)[order]
    apart = (high.astype(np.int16) - low).max(axis=-1)
    usual = float(np.median(apart))
    moves = binary_opening(apart > max(SPREAD * usual, usual + SPREAD_LEVELS), np.ones((3, 3)))
    return middle, np.logical_not(maximum_filter(moves, size=REACH_PX))


def draw_with_plates(sweep: RaySet, fixed: RaySet | None, n: int, generator: torch.Generator) -> RayBatch:
    """Draw rays of the sweep and, a share of them, of the fixed cameras' plates."""
    if fixed is None:
        return sweep.draw(n, generator)
    of_fixed = round(SHARE * n)
    return sweep.draw(n - of_fixed, generator).joined(fixed.draw(of_fixed, generator))


def stands(clip: Sequence[PosedFrame]) -> bool:
    """Whether a camera has one pose and one lens in all of its pictures."""
    return len({f.camera.cam_from_world.tobytes() + f.camera.K.tobytes() for f in clip}) == 1
