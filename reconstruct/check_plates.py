"""The scene at rest against the clean plate of each fixed training camera, and what it is that does not fit.

A plate is what a camera shows of what stands, over all of its clip, so a clip need not begin at rest for it. The model
has learned from it: what it could not learn contradicts the sweep and the other cameras. How much of the error one gain
per colour takes away is what the light has done. Pose, lens and clock are also asked of the picture at rest where the
plate ends, which the sweep alone has taught: a small shift or another moment of the clip takes away what they do.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, label

from devrf.capture.scene import PosedFrame, Scene
from devrf.reconstruct.aligned import aligned
from devrf.reconstruct.check_rest import (
    HELD_OUT,
    LUMA,
    Render,
    at_rest,
    picture_of,
    renderer_at_rest,
    scale_of,
    voxel_width,
)
from devrf.reconstruct.displacement import Displacement, displacement, textured_blocks
from devrf.reconstruct.pictures import spread
from devrf.reconstruct.rest_model import RestModel
from devrf.reconstruct.still_picture import plate, standing_clips

LEAST_KNOWN = 0.02  # of the picture, for an error that means something
MOMENTS = 3  # pictures before and after the one at rest: clocks are seldom wrong by more
# What stands out: of the full range, after a blur, noise and soft edges are below; and it has this share of the squared
# error: in pictures that are blurred all over nothing does.
DIFFERENCE, BLUR_PX, OF_ERROR = 0.1, 1.5, 0.5

Picture = Float[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class PlateFit:
    """One camera's clean plate against the model at rest.

    Attributes:
        known: Share of its picture over which nothing ever moved; the rest is measured there.
        textured: Blocks of the picture that have texture.
        psnr: dB; None where hardly anything is known.
        displaced: How far the plate lies beside the model's picture; None where it has too little texture.
        voxel: What a voxel in the middle of the box measures in the picture, in its widths.
        by_place: Share of the squared error that one small affine map takes away.
        by_light: Share of the squared error that one gain per colour takes away.
        rest_by_place: Share of the error of the picture at rest, where things move later, that such a map takes away.
        rest_by_time: Share of it that another moment takes away; both are 0 of a clip that does not show the rest.
        odd: The largest piece that stands out: its share of the picture.
        odd_at: Its middle, from the left and from the top, in the picture's sides.
    """

    known: float
    textured: int
    psnr: float | None
    displaced: Displacement | None
    voxel: float
    by_place: float = 0.0
    by_light: float = 0.0
    rest_by_place: float = 0.0
    rest_by_time: float = 0.0
    odd: float = 0.0
    odd_at: tuple[float, float] = (0.5, 0.5)


def check_plates(
    scene: Scene, rest: RestModel, render: Render | None = None
) -> tuple[dict[str, PlateFit], list[float]]:
    """Compare the plate of every fixed training camera that has one.

    Args:
        scene: Any frame.
        rest: The scene at rest.
        render: Renders it; None: by one of its own.
    Returns:
        By camera; and the PSNR of some held-out pictures of the sweep, if there is a camera. None before a plain
        background, where nothing is seen beside the subject.
    """
    scene = scene.in_box_frame()
    render = render or renderer_at_rest(rest)
    standing = standing_clips(scene)
    if scene.background != "shell" or not standing:
        return {}, []
    held_out = spread([frame for frame in scene.static if frame.split == "test"], HELD_OUT)
    everywhere = [
        _psnr(_error(picture_of(scene, f), render(f.camera.scaled(scale_of(scene, f.camera)))))
        for f in held_out
    ]
    return {name: _fit(scene, rest, render, clip) for name, clip in standing.items()}, everywhere


def _fit(scene: Scene, rest: RestModel, render: Render, clip: Sequence[PosedFrame]) -> PlateFit:
    scale = scale_of(scene, clip[0].camera)
    stood, known = plate(replace(scene, image_scale=scale), clip)
    picture, camera = stood.astype(np.float32) / 255, clip[0].camera.scaled(scale)
    share, voxel = float(known.mean()), voxel_width(rest, camera)
    textured = len(textured_blocks(picture @ LUMA, known))
    if share < LEAST_KNOWN:
        return PlateFit(share, textured, None, None, voxel)
    rendered = render(camera)
    error = _error(picture[known], rendered[known])
    gains = (picture * rendered)[known].sum(0) / np.maximum((rendered[known] ** 2).sum(0), 1e-9)
    odd, odd_at = _standing_out(picture, rendered, known)
    rest_by_place, rest_by_time = _at_rest(scene, clip, rendered, ~known)
    return PlateFit(
        share,
        textured,
        _psnr(error),
        displacement(picture @ LUMA, rendered @ LUMA, known),
        voxel,
        _by_place(picture, rendered, known),
        _taken_away(error, _error(picture[known], (gains * rendered)[known])),
        rest_by_place,
        rest_by_time,
        odd,
        odd_at,
    )


def _at_rest(scene: Scene, clip: Sequence[PosedFrame], rendered: Picture, where: Mask) -> tuple[float, float]:
    """What a shift, and what the best of the pictures around it, take away of the error of the picture at rest."""
    found = at_rest(scene, clip)
    if found is None or where.mean() < LEAST_KNOWN:
        return 0.0, 0.0
    at = [frame.index for frame in clip].index(found.index)
    first = max(0, at - MOMENTS)
    pictures = [picture_of(scene, frame) for frame in clip[first : at + MOMENTS + 1]]
    errors = [_error(picture[where], rendered[where]) for picture in pictures]
    return _by_place(pictures[at - first], rendered, where), _taken_away(errors[at - first], min(errors))


def _by_place(picture: Picture, rendered: Picture, where: Mask) -> float:
    moved = aligned(rendered, picture, where)
    return _taken_away(_error(picture[where], rendered[where]), _error(picture[where], moved[where]))


def _standing_out(picture: Picture, rendered: Picture, known: Mask) -> tuple[float, tuple[float, float]]:
    """Share of the picture, and the middle, of the largest piece that differs by much, if it is what differs."""
    left = (picture - rendered) * known[..., None]
    apart = gaussian_filter(np.abs(left).max(axis=-1), BLUR_PX) > DIFFERENCE
    pieces, count = label(apart, structure=np.ones((3, 3)))  # type: ignore[misc]
    if not count:
        return 0.0, (0.5, 0.5)
    sizes = np.bincount(pieces.reshape(-1))
    sizes[0] = 0
    piece = pieces == sizes.argmax()
    if (left[piece] ** 2).sum() < OF_ERROR * (left**2).sum():
        return 0.0, (0.5, 0.5)
    v, u = np.nonzero(piece)
    height, width = known.shape
    return float(sizes.max() / known.size), (float(u.mean() + 0.5) / width, float(v.mean() + 0.5) / height)


def _error(one: np.ndarray, other: np.ndarray) -> float:
    return max(1e-10, float(((one - other) ** 2).mean()))


def _psnr(error: float) -> float:
    return float(-10 * np.log10(error))


def _taken_away(before: float, after: float) -> float:
    return max(0.0, 1 - after / before)
