"""The scene at rest against what each fixed camera sees of it, before motion is learned from these cameras.

A fixed camera that is wrong (pose, focal length, exposure, blur), a clip that does not begin at rest, a sweep in
which something moved: all of them show as a picture that the model does not explain as it explains the sweep's own
held-out pictures. Two measures: how far the picture lies beside the model's (`displacement.py`), and its error where
the box is seen. At rest is a camera's picture nearest to the time of rest; of a clip that does not show the scene at
rest (it never rests, or this camera began later), the median in pixels that do not change.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image, plain_colour
from devrf.reconstruct.clocks import picture_gap_s
from devrf.reconstruct.displacement import Displacement, displacement
from devrf.reconstruct.grids import voxel_size
from devrf.reconstruct.model import DynamicModel, render_view
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.pictures import clips, spread
from devrf.reconstruct.rays import RaySet, camera_rays
from devrf.reconstruct.render import segments_in
from devrf.reconstruct.rest_model import RestModel

SIDE_PX = 192  # of the longer side, at most: a shift of a thousandth of the width is still found, in a second or two
# pictures of the sweep to compare with, spread over it: their spread is seen, and little time taken
HELD_OUT = 4
AT_REST = 1.5  # picture gaps: clocks that run free have a picture within one of every time that they film
OF_CLIP = 9  # pictures, for the median of a clip that never rests
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601
PLAIN_APART = 2 / 255  # from the plain background: nothing of the subject
LEAST_PIXELS = 100  # for an error that means something


@dataclass(frozen=True)
class RestFit:
    """One picture of the scene at rest against the model.

    Attributes:
        psnr: Where the box is seen, dB; None where hardly any of it is.
        displaced: How far the picture lies beside the model's; None where it has too little texture.
        voxel: What a voxel in the middle of the box measures in the picture, in its widths.
    """

    psnr: float | None
    displaced: Displacement | None
    voxel: float


Render = Callable[[Camera], Float[np.ndarray, "height width 3"]]


def renderer_at_rest(rest: RestModel) -> Render:
    """How the scene at rest looks from cameras in the box frame; each picture is rendered once and kept."""
    kept: dict[object, Float[np.ndarray, "height width 3"]] = {}
    model = DynamicModel(rest)

    def render(camera: Camera) -> Float[np.ndarray, "height width 3"]:
        if camera.view not in kept:
            kept[camera.view] = render_view(model, camera, None)
        return kept[camera.view]

    return render


def check_rest(
    scene: Scene, rest: RestModel, render: Render | None = None
) -> tuple[dict[str, RestFit], list[RestFit]]:
    """Compare every training camera of the moving scene, and some held-out pictures of the sweep.

    Args:
        scene: Any frame.
        rest: The scene at rest.
        render: Renders it; None: by one of its own.
    Returns:
        By camera; cameras that move while the scene never rests are left out. And the sweep's, if there is a camera.
    """
    scene = scene.in_box_frame()
    render = render or renderer_at_rest(rest)
    fits = {
        name: fit
        for name, clip in clips(scene).items()
        if (fit := _of_clip(scene, rest, render, clip)) is not None
    }
    if not fits:  # the sweep is asked for their sake
        return {}, []
    held_out = spread([frame for frame in scene.static if frame.split == "test"], HELD_OUT)
    return fits, [
        _fit(scene, rest, render, frame.camera, picture_of(scene, frame), None) for frame in held_out
    ]


def _of_clip(scene: Scene, rest: RestModel, render: Render, clip: Sequence[PosedFrame]) -> RestFit | None:
    nearest = at_rest(scene, clip)
    if nearest is not None:
        return _fit(scene, rest, render, nearest.camera, picture_of(scene, nearest), None)
    few = spread(clip, OF_CLIP)
    if len(few) < 3 or any((f.camera.cam_from_world != few[0].camera.cam_from_world).any() for f in few):
        return None
    rays = RaySet(tuple(few), scale_of(scene, few[0].camera), scene.background)
    height, width = rays.cameras[0].height, rays.cameras[0].width
    still = np.ones(height * width, bool)
    still[changing_pixels(rays).of_frame[0].numpy()] = False
    pictures = rays.pixels.reshape(len(few), height, width, 3).numpy()
    median = np.median(pictures, axis=0).astype(np.float32) / 255
    return _fit(scene, rest, render, few[0].camera, median, still.reshape(height, width))


def at_rest(scene: Scene, clip: Sequence[PosedFrame]) -> PosedFrame | None:
    """The camera's picture of the scene at rest, if it filmed then."""
    rest_time = scene.rest_time
    if rest_time is None:
        return None

    def away(frame: PosedFrame) -> float:
        return abs((frame.time or 0.0) - rest_time)

    nearest = min(clip, key=away)
    longest = AT_REST * picture_gap_s(clip) / (scene.t1_s - scene.t0_s)
    return nearest if away(nearest) <= longest else None


def _fit(
    scene: Scene,
    rest: RestModel,
    render: Render,
    camera: Camera,
    picture: Float[np.ndarray, "height width 3"],
    asked: Bool[np.ndarray, "height width"] | None,
) -> RestFit:
    camera = camera.scaled(scale_of(scene, camera))
    rendered = render(camera)
    where = _sees_box(rest, camera) if asked is None else asked & _sees_box(rest, camera)
    plain = plain_colour(scene.background)
    if plain is not None:
        where &= (
            np.maximum(*(np.abs(p - np.array(plain)).max(axis=2) for p in (picture, rendered))) > PLAIN_APART
        )
    psnr = None
    if where.sum() >= LEAST_PIXELS:
        psnr = float(-10 * np.log10(max(1e-10, ((picture - rendered)[where] ** 2).mean())))
    return RestFit(psnr, displacement(picture @ LUMA, rendered @ LUMA, asked), voxel_width(rest, camera))


def _sees_box(rest: RestModel, camera: Camera) -> Bool[np.ndarray, "height width"]:
    rays_o, rays_d = camera_rays(camera)
    box = rest.canonical
    segments = segments_in(box.aabb.cpu(), box.ndc, rays_o, rays_d, rest.near, torch.zeros(len(rays_o)))
    return (segments.t_out > segments.t_in).reshape(camera.height, camera.width).numpy()


def voxel_width(rest: RestModel, camera: Camera) -> float:
    """What a voxel in the middle of the box measures in a picture, in its widths."""
    box = rest.canonical
    if box.ndc is not None:  # the reference camera's picture is as wide as the box
        return 1 / box.shape[0]
    away = float(np.linalg.norm(camera.centre - box.aabb.cpu().numpy().mean(axis=0)))
    return voxel_size(box.aabb, box.shape) * float(camera.K[0, 0]) / (max(away, rest.near) * camera.width)


def picture_of(scene: Scene, frame: PosedFrame) -> Float[np.ndarray, "height width 3"]:
    """A picture in [0, 1], at the size at which it is compared."""
    return load_image(frame, scale_of(scene, frame.camera), scene.background).astype(np.float32) / 255


def scale_of(scene: Scene, camera: Camera) -> float:
    """How much smaller a camera's pictures are compared than they are."""
    return min(scene.image_scale, SIDE_PX / max(camera.width, camera.height))
