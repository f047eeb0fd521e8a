"""The motion that was learned against the pictures that it was learned from, camera by camera.

Pictures say more of a motion than its loss does. Where they change, five things are measured on a few rays of a few
pictures: by how much the motion explains them better than the scene at rest; how much of what the scene at rest
leaves unexplained lies where the model shows nothing at any time, so that no motion can explain it, and how much where
it shows the same as at rest, as if nothing had moved there; how much of the surface that changes no other camera sees
from aside, so that its depth is a guess; and whether the pictures would fit better as if they had been taken a little
earlier or later.

A motion has far fewer numbers than the pictures have pixels, so pixels need not be held back from training for this.
What fits each picture by a motion of its own (wrong cameras) is not seen here but at rest (`check_rest.py`).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.special import stdtrit
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.spread import spread
from devrf.reconstruct.evaluation.error_curves import error_curves, picture_gap_s
from devrf.reconstruct.fields.grids import voxel_size
from devrf.reconstruct.options import CHUNK
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.sampling.moving_pixels import changing_pixels, draw_with_importance, grown_pixels
from devrf.reconstruct.sampling.pictures import clips

PICTURES = 8  # of each camera, spread over its clip
RAYS = 96  # of each picture, where pictures change: a camera's gain is known to a tenth of a decibel or two
SURE = 0.977  # that another time is better, by Student's t over pictures: two standard errors of many
FEWEST_PICTURES = 4  # that can be compared at two times
LEAST_SHIFT_DB = 0.1  # that another time must gain to be worth a word
SHIFTS = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])  # pictures by which a camera is tried to be early or late
OPAQUE = 0.5  # opacity from which something is there
# Of the full range: what the model changes by less looks as at rest. By 0.02 captures in which all that moves is found
# differ from others, too; by 0.01 they do not.
UNMOVED = 0.05
# Voxels: between depths of two cameras, a surface two to three voxels thick, seen at a slant; and by which a depth may
# be wrong where the other camera is wrong by a pixel: more than that is another surface.
SAME_SURFACE = 6.0


@dataclass(frozen=True)
class MotionFit:
    """What the pictures of one camera say of the motion.

    Attributes:
        gain_db: Error of the scene at rest over that of the motion, where the camera's pictures change.
        unreachable: Share of the error of the scene at rest where the box is empty at rest and at the picture's time.
        unmoved: Share of that error where the model is not empty, and looks at the picture's time as it does at rest.
        alone: Share of the changing surface that no other training camera sees from far enough aside to tell its
            depth; None where no surface changes.
        better_at: Pictures by which they would have to be later (> 0) or earlier (< 0) to fit the motion clearly
            better, of SHIFTS; 0 where none is clearly better.
    """

    gain_db: float
    unreachable: float
    unmoved: float
    alone: float | None
    better_at: float


@torch.no_grad()
def check_motion(scene: Scene, model: DynamicModel, seed: int = 0) -> dict[str, MotionFit]:
    """Look at every training camera that stands still and whose pictures change by more than a flicker.

    Where pictures change is found by comparing those of one pose: of a camera that moves nothing is asked.

    Args:
        scene: Any frame; its times are the ones that the motion was learned with.
        model: With its motion.
        seed: Of the pixels that are looked at.
    """
    scene = scene.in_box_frame()
    assert model.motion is not None  # asked of models with motion only
    by_camera = clips(scene)
    frames = tuple(frame for clip in by_camera.values() for frame in spread(clip, PICTURES))
    device = model.rest.canonical.density.device
    rays = RaySet(frames, scene.image_scale, scene.background, str(device))
    changing = changing_pixels(rays)
    changed = zip(frames, changing.of_frame, rays.cameras, strict=True)
    asked = {f.camera_name for f, where, view in changed if len(where) > grown_pixels(view)}
    if not asked:
        return {}
    counts = torch.tensor([f.camera_name in asked for f in frames], device=device)
    pictures = counts.nonzero()[:, 0]
    generator = torch.Generator().manual_seed(seed)
    batch = draw_with_importance(rays, changing, RAYS * len(pictures), 1.0, pictures, generator)
    surroundings = PixelSurroundings(model, rays)
    around = surroundings.at(batch.frame, batch.pixel)

    def error(rgb: Tensor, left: Tensor) -> Tensor:
        return ((around.compose(rgb, left) - batch.rgb) ** 2).mean(1)

    parts = zip(batch.rays_o.split(CHUNK), batch.rays_d.split(CHUNK), strict=True)
    still = [model.box_at_rest(o, d) for o, d in parts]
    rest_left = torch.cat([part.left for part in still])
    rest_rgb = torch.cat([part.rgb for part in still])
    at_rest = error(rest_rgb, rest_left)
    names = list(by_camera)
    of_frame = torch.tensor([names.index(f.camera_name) for f in frames], device=device)
    camera = of_frame[batch.frame]
    rgb, left, depth = model.box_at(batch.rays_o, batch.rays_d, batch.time)
    in_motion = error(rgb, left)
    gaps = torch.tensor([picture_gap_s(clip) for clip in by_camera.values()], device=device)[of_frame]
    shifts = torch.from_numpy(SHIFTS).to(rays.times) * gaps[:, None] / (scene.t1_s - scene.t0_s)
    times = (rays.times[:, None] + shifts).to(rays.times)
    times[~counts] = torch.nan  # at no time: these pictures are not rendered
    curves = error_curves(model, rays, surroundings, changing, times, generator)
    empty = torch.minimum(left, rest_left) > OPAQUE
    unmoved = ((rgb - rest_rgb).abs().amax(1) < UNMOVED) & ((left - rest_left).abs() < UNMOVED) & ~empty
    solid = (left < OPAQUE).nonzero()[:, 0]
    surface = batch.rays_o + (depth / (1 - left).clamp_min(1e-6))[:, None] * batch.rays_d
    others = _seen_by_others(
        model, rays, camera[solid], batch.rays_o[solid], surface[solid], batch.time[solid]
    )
    out = {}
    for n, name in enumerate(names):
        mine = camera == n
        if name not in asked:
            continue
        before = max(float(at_rest[mine].sum()), 1e-12)
        out[name] = MotionFit(
            gain_db=10 * math.log10(before / max(float(in_motion[mine].sum()), 1e-12)),
            unreachable=float(at_rest[mine & empty].sum()) / before,
            unmoved=float(at_rest[mine & unmoved].sum()) / before,
            alone=float((~others[mine[solid]]).float().mean()) if bool(mine[solid].any()) else None,
            better_at=better_shift(curves[of_frame.cpu().numpy() == n]),
        )
    return out


def better_shift(curves: Float[np.ndarray, "pictures shifts"]) -> float:
    """The shift at which pictures fit clearly better than as they are, else 0.

    Args:
        curves: Squared errors at SHIFTS; NaN where the motion knows nothing. Pictures that are known both as they are
            and at a shift are compared there.
    """
    now = curves[:, SHIFTS == 0]
    both = np.isfinite(curves) & np.isfinite(now)
    comparable = both.sum(0) >= FEWEST_PICTURES
    if not comparable.any():
        return 0.0
    before, after = np.where(both, now, 0.0).sum(0), np.where(both, curves, 0.0).sum(0)
    ratio = np.where(comparable, before / np.maximum(after, 1e-12), 0.0)
    best = int(ratio.argmax())
    gained = (now[:, 0] - curves[:, best])[both[:, best]]
    n = len(gained)
    sure = gained.mean() > stdtrit(n - 1, SURE) * gained.std(ddof=1) / math.sqrt(n)
    return float(SHIFTS[best]) if sure and ratio[best] > 10 ** (LEAST_SHIFT_DB / 10) else 0.0


def _seen_by_others(
    model: DynamicModel,
    rays: RaySet,
    camera: Int[Tensor, " s"],
    seen_from: Float[Tensor, "s 3"],
    points: Float[Tensor, "s 3"],
    time: Float[Tensor, " s"],
) -> Bool[Tensor, " s"]:
    """Whether a training camera other than its own sees a point of the moving surface at the point's time.

    And whether it does so from aside: along the own line of sight, a pixel of the other camera is d / (f sin a), of its
    distance d, its focal length f, and the angle a between both lines.
    """
    canonical = model.rest.canonical
    tolerance = SAME_SURFACE * voxel_size(canonical.aabb, canonical.shape)

    def grid(x: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Where voxels are alike."""
        return x if canonical.ndc is None else canonical.ndc.from_world(x)

    views = {f.camera_name: n for n, f in enumerate(rays.frames)}
    seen = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    for number, view in enumerate(views.values()):
        other = rays.cameras[view]
        pixel = np.nan_to_num(other.project(points.double().cpu().numpy()), nan=-1.0)
        inside = ((pixel >= 0) & (pixel < [other.width, other.height])).all(-1)
        asked = (torch.from_numpy(inside).to(seen.device) & (camera != number) & ~seen).nonzero()[:, 0]
        towards = points[asked] - rays.centres[view]
        away = towards.norm(dim=1)
        origin = rays.centres[view].expand(len(asked), 3).contiguous()
        _, left, depth = model.box_at(origin, towards / away[:, None], time[asked])
        hit = origin + (depth / (1 - left).clamp_min(1e-6) / away)[:, None] * towards
        apart = (grid(hit) - grid(points[asked])).norm(dim=1)
        along = torch.nn.functional.normalize(points[asked] - seen_from[asked], dim=1)
        aside = torch.linalg.cross(along, towards / away[:, None]).norm(dim=1).clamp_min(1e-9)
        pixel_along = (away / (float(other.K[0, 0]) * aside))[:, None] * along
        vague = (grid(points[asked] + pixel_along) - grid(points[asked])).norm(dim=1)
        seen[asked] = (left < OPAQUE) & (apart < tolerance) & (vague < tolerance)
    return seen
