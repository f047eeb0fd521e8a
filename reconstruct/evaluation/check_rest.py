"""The scene at rest against what each fixed training camera shows of it, before motion is learned from these cameras.

A fixed camera that is wrong (pose, focal length, exposure, blur), a clip that does not begin at rest, a sweep in
which something moved: all of them show as a picture that the model does not explain as it explains the sweep's own
held-out pictures. Two pictures are asked of each camera how far they lie beside the model's (`displacement.py`), and
how far they differ from it.

At rest is a camera's picture nearest to the time of rest; of a clip that does not show the scene at rest (it never
rests, or this camera began later), the median in pixels that do not change. It is compared where the box is seen.

A clean plate is what a camera shows of what stands, over all of its clip, so a clip need not begin at rest for it. The
model has learned from it: what it could not learn contradicts the sweep and the other cameras. How much of the error
one gain per colour takes away is what the light has done. Pose, lens and clock are also asked of the picture at rest
where the plate ends, which the sweep alone has taught: a small shift or another moment of the clip takes away what
they do.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter, label

from devrf.capture.camera import Camera
from devrf.capture.scene import PosedFrame, Scene, load_image, plain_colour
from devrf.capture.system.spread import spread
from devrf.reconstruct.evaluation.aligned import aligned
from devrf.reconstruct.evaluation.displacement import Displacement, displacement, textured_blocks
from devrf.reconstruct.evaluation.error_curves import picture_gap_s
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import voxel_size
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.rendering.rays import RaySet, camera_rays
from devrf.reconstruct.rendering.render import segments_in
from devrf.reconstruct.sampling.clean_plate import plate, standing_clips
from devrf.reconstruct.sampling.moving_pixels import changing_pixels
from devrf.reconstruct.sampling.pictures import clips

SIDE_PX = 192  # of the longer side, at most: a shift of a thousandth of the width is still found, in a second or two
# pictures of the sweep to compare with, spread over it: their spread is seen, and little time taken
HELD_OUT = 4
AT_REST = 1.5  # picture gaps: clocks that run free have a picture within one of every time that they film
OF_CLIP = 9  # pictures, for the median of a clip that never rests
LUMA = np.array([0.299, 0.587, 0.114])  # Rec. 601
PLAIN_APART = 2 / 255  # from the plain background: nothing of the subject
LEAST_PIXELS = 100  # for an error that means something
LEAST_KNOWN = 0.02  # of the picture, for a plate, or what is beside it, that means something
MOMENTS = 3  # pictures before and after the one at rest: clocks are seldom wrong by more
# What stands out: of the full range, after a blur, noise and soft edges are below; and it has this share of the squared
# error: in pictures that are blurred all over nothing does.
DIFFERENCE, BLUR_PX, OF_ERROR = 0.1, 1.5, 0.5

Picture = Float[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]
Render = Callable[[Camera], Picture]


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


@dataclass(frozen=True)
class PlateFit(RestFit):
    """One camera's clean plate against the model at rest, compared where it is known.

    Attributes:
        known: Share of its picture over which nothing ever moved.
        textured: Blocks of the picture that have texture.
        by_place: Share of the squared error that one small affine map takes away.
        by_light: Share of the squared error that one gain per colour takes away.
        rest_by_place: Share of the error of the picture at rest, where things move later, that such a map takes away.
        rest_by_time: Share of it that another moment takes away; both are 0 of a clip that does not show the rest.
        odd: The largest piece that stands out: its share of the picture.
        odd_at: Its middle, from the left and from the top, in the picture's sides.
    """

    known: float
    textured: int
    by_place: float = 0.0
    by_light: float = 0.0
    rest_by_place: float = 0.0
    rest_by_time: float = 0.0
    odd: float = 0.0
    odd_at: tuple[float, float] = (0.5, 0.5)


@dataclass(frozen=True)
class RestCheck:
    """What cameras show of the scene at rest, against the model.

    Attributes:
        cameras: The picture at rest of each training camera of the moving scene; cameras that move while the scene
            never rests are left out.
        plates: The clean plate of each that has one; none before a plain background, where nothing is seen beside the
            subject.
        sweep: Some held-out pictures of the sweep, which say how well the model fits pictures that are right.
        sweep_psnr: Of the same pictures, whole, dB.
    """

    cameras: Mapping[str, RestFit] = field(default_factory=dict)
    plates: Mapping[str, PlateFit] = field(default_factory=dict)
    sweep: Sequence[RestFit] = ()
    sweep_psnr: Sequence[float] = ()


def check_rest(scene: Scene, rest: RestModel, render: Render | None = None) -> RestCheck:
    """Compare every training camera of the moving scene and, if there is one, some held-out pictures of the sweep.

    Args:
        scene: Any frame.
        rest: The scene at rest.
        render: Renders it from cameras in the box frame; None: by the model.
    """
    scene = scene.in_box_frame()
    comparison = _Comparison(scene, rest, render or _renderer(rest))
    fits = {name: comparison.at_rest(clip) for name, clip in clips(scene).items()}
    standing = standing_clips(scene) if scene.background == "shell" else {}
    cameras = {name: fit for name, fit in fits.items() if fit is not None}
    if not cameras:  # the sweep is asked for their sake; a camera that stands is among them
        return RestCheck()
    held_out = spread([frame for frame in scene.static if frame.split == "test"], HELD_OUT)
    return RestCheck(
        cameras,
        {name: comparison.plate(clip) for name, clip in standing.items()},
        [comparison.picture(frame) for frame in held_out],
        [comparison.whole(frame) for frame in held_out],
    )


class _Comparison:
    """Pictures of a scene, in the box frame, against the model at rest."""

    def __init__(self, scene: Scene, rest: RestModel, render: Render) -> None:
        self._scene, self._rest, self._render = scene, rest, render

    def at_rest(self, clip: Sequence[PosedFrame]) -> RestFit | None:
        """A camera's picture at rest, or the median of its clip where that has none; None where it then moves."""
        nearest = self._nearest(clip)
        if nearest is not None:
            return self.picture(nearest)
        few = spread(clip, OF_CLIP)
        if len(few) < 3 or any((f.camera.cam_from_world != few[0].camera.cam_from_world).any() for f in few):
            return None
        rays = RaySet(tuple(few), _scale(self._scene, few[0].camera), self._scene.background)
        height, width = rays.cameras[0].height, rays.cameras[0].width
        still = np.ones(height * width, bool)
        still[changing_pixels(rays).of_frame[0].numpy()] = False
        pictures = rays.pixels.reshape(len(few), height, width, 3).numpy()
        median = np.median(pictures, axis=0).astype(np.float32) / 255
        return self._in_box(few[0].camera, median, still.reshape(height, width))

    def picture(self, frame: PosedFrame) -> RestFit:
        """A picture that shows the scene at rest."""
        return self._in_box(frame.camera, _load(self._scene, frame), None)

    def whole(self, frame: PosedFrame) -> float:
        """PSNR of all of a picture that shows the scene at rest, dB."""
        return _psnr(_error(_load(self._scene, frame), self._rendered(frame.camera)))

    def plate(self, clip: Sequence[PosedFrame]) -> PlateFit:
        """A camera's clean plate, and its picture at rest beside that."""
        camera = clip[0].camera
        stood, known = plate(replace(self._scene, image_scale=_scale(self._scene, camera)), clip)
        picture, share = stood.astype(np.float32) / 255, float(known.mean())
        textured = len(textured_blocks(picture @ LUMA, known))
        if share < LEAST_KNOWN:
            return PlateFit(None, None, _voxel_width(self._rest, camera), share, textured)
        rendered = self._rendered(camera)
        fit = self._fit(camera, picture, known, known)
        error = _error(picture[known], rendered[known])
        gains = (picture * rendered)[known].sum(0) / np.maximum((rendered[known] ** 2).sum(0), 1e-9)
        by_light = _taken_away(error, _error(picture[known], (gains * rendered)[known]))
        beside = self._beside(clip, ~known)
        odd = _standing_out(picture, rendered, known)
        by_place = _by_place(picture, rendered, known)
        return PlateFit(
            fit.psnr, fit.displaced, fit.voxel, share, textured, by_place, by_light, *beside, *odd
        )

    def _nearest(self, clip: Sequence[PosedFrame]) -> PosedFrame | None:
        """The camera's picture of the scene at rest, if it filmed then."""
        rest_time = self._scene.rest_time
        if rest_time is None:
            return None

        def away(frame: PosedFrame) -> float:
            return abs((frame.time or 0.0) - rest_time)

        nearest = min(clip, key=away)
        longest = AT_REST * picture_gap_s(clip) / (self._scene.t1_s - self._scene.t0_s)
        return nearest if away(nearest) <= longest else None

    def _beside(self, clip: Sequence[PosedFrame], where: Mask) -> tuple[float, float]:
        """What a shift, and what the best of the pictures around it, take away of the error of the picture at rest."""
        found = self._nearest(clip)
        if found is None or where.mean() < LEAST_KNOWN:
            return 0.0, 0.0
        rendered = self._rendered(found.camera)
        at = [frame.index for frame in clip].index(found.index)
        first = max(0, at - MOMENTS)
        pictures = [_load(self._scene, frame) for frame in clip[first : at + MOMENTS + 1]]
        errors = [_error(picture[where], rendered[where]) for picture in pictures]
        by_time = _taken_away(errors[at - first], min(errors))
        return _by_place(pictures[at - first], rendered, where), by_time

    def _in_box(self, camera: Camera, picture: Picture, asked: Mask | None) -> RestFit:
        """How a picture fits where the box is seen; before a plain background, where either shows something else."""
        where = self._sees_box(camera) if asked is None else asked & self._sees_box(camera)
        plain = plain_colour(self._scene.background)
        if plain is not None:
            apart = (np.abs(p - np.array(plain)).max(axis=2) for p in (picture, self._rendered(camera)))
            where &= np.maximum(*apart) > PLAIN_APART
        return self._fit(camera, picture, asked, where)

    def _fit(self, camera: Camera, picture: Picture, asked: Mask | None, where: Mask) -> RestFit:
        """How far a picture lies beside the model's, by what is asked of it, and its error somewhere."""
        rendered, psnr = self._rendered(camera), None
        if where.sum() >= LEAST_PIXELS:
            psnr = _psnr(_error(picture[where], rendered[where]))
        beside = displacement(picture @ LUMA, rendered @ LUMA, asked)
        return RestFit(psnr, beside, _voxel_width(self._rest, camera))

    def _rendered(self, camera: Camera) -> Picture:
        return self._render(camera.scaled(_scale(self._scene, camera)))

    def _sees_box(self, camera: Camera) -> Mask:
        small = camera.scaled(_scale(self._scene, camera))
        rays_o, rays_d = camera_rays(small)
        box = self._rest.canonical
        near = torch.zeros(len(rays_o))
        segments = segments_in(box.aabb.cpu(), box.ndc, rays_o, rays_d, self._rest.near, near)
        return (segments.t_out > segments.t_in).reshape(small.height, small.width).numpy()


def _renderer(rest: RestModel) -> Render:
    """How the scene at rest looks; each picture is rendered once and kept."""
    kept: dict[object, Picture] = {}
    model = DynamicModel(rest)

    def render(camera: Camera) -> Picture:
        if camera.view not in kept:
            kept[camera.view] = render_view(model, camera, None)
        return kept[camera.view]

    return render


def _load(scene: Scene, frame: PosedFrame) -> Picture:
    """A picture in [0, 1], at the size at which it is compared."""
    return load_image(frame, _scale(scene, frame.camera), scene.background).astype(np.float32) / 255


def _scale(scene: Scene, camera: Camera) -> float:
    """How much smaller a camera's pictures are compared than they are."""
    return min(scene.image_scale, SIDE_PX / max(camera.width, camera.height))


def _voxel_width(rest: RestModel, camera: Camera) -> float:
    """What a voxel in the middle of the box measures in a picture, in its widths."""
    box = rest.canonical
    if box.ndc is not None:  # the reference camera's picture is as wide as the box
        return 1 / box.shape[0]
    away = float(np.linalg.norm(camera.centre - box.aabb.cpu().numpy().mean(axis=0)))
    return voxel_size(box.aabb, box.shape) * float(camera.K[0, 0]) / (max(away, rest.near) * camera.width)


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
