"""What a trained model shows from many places and times: pictures, and where in space each pixel lies.

Pictures are asked of the model, not of the cameras, so that there may be as many as are wanted, from between the
cameras too, and so that surroundings, motion and colours are those of `render_view`. Test pictures are never read.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.scene import Scene, image_scale_for
from devrf.capture.system.progress import Progress, no_progress
from devrf.capture.system.spread import spread
from devrf.reconstruct.fields.contracted_background import CUBE, Shell
from devrf.reconstruct.fields.grids import vertices
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.fields.movers import Movers
from devrf.reconstruct.geometry import seen
from devrf.reconstruct.geometry.camera_arc import film_cameras, film_lens
from devrf.reconstruct.geometry.paths import orbit
from devrf.reconstruct.kernels.background import expand
from devrf.reconstruct.kernels.march import RaySegments, intersect
from devrf.reconstruct.rendering.model import DynamicModel, render_view
from devrf.reconstruct.rendering.rays import camera_rays
from devrf.reconstruct.sampling.pictures import clips, training

# of a picture, before it is made square: what 400 x 300 shows; a smaller training size stays
MOST_PIXELS = 120_000
OF_SWEEP = 16  # pictures from the sweep's poses
OF_MOTION = 16  # from the moving cameras' places, over all of them
OF_FILM = 12  # on a path between the cameras
SOLID = 0.5  # opacity of surroundings before the box from which they are what a pixel shows
EDGE = 2.2  # half size of the cube that places in contracted space are coded in: a little more than it has


@dataclass(frozen=True)
class ModelView:
    """A picture of the model.

    Attributes:
        camera: In the box frame, without lens distortion.
        time: In [0, 1]; None at rest.
        picture: RGB.
    """

    camera: Camera
    time: float | None
    picture: Float[Tensor, "H W 3"]


@dataclass(frozen=True)
class PlacedView(ModelView):
    """A picture of the model at rest, and where its pixels lie.

    Attributes:
        places: Of what each pixel shows, in the box frame; NaN where nothing is, or it is not clear.
        is_body: Which of them are in the box.
    """

    places: Float[Tensor, "H W 3"]
    is_body: Bool[Tensor, "H W"]


def look_around(
    scene: Scene, model: DynamicModel, progress: Progress = no_progress
) -> tuple[list[PlacedView], list[ModelView]]:
    """Pictures of the scene at rest from the sweep's poses, and others, in motion where there is some.

    Args:
        scene: In the box frame.
        model: As it is rendered.
    """
    poses, moments = views(scene, model.motion)
    at_rest = None if model.motion is None else rest_time(model.motion)
    still = model if model.movers is None else replace(model, movers=_still(model.movers))
    coded = None if model.rest.shell is None else coded_shell(model.rest.shell)
    placed, others = [], []
    for n, pose in enumerate([*poses, *moments]):
        if isinstance(pose, Camera):
            placed.append(look(still, pose, at_rest, coded))
        else:
            picture = torch.from_numpy(render_view(model, *pose)).to(model.rest.canonical.density.device)
            others.append(ModelView(*pose, picture))
        count = len(poses) + len(moments)
        progress((n + 1) / count, f"looking: {n + 1} of {count} pictures")
    return placed, others


def views(scene: Scene, motion: MotionField | None) -> tuple[list[Camera], list[tuple[Camera, float | None]]]:
    """Poses to look from at rest; cameras and times to look from and at beside them."""

    def small(camera: Camera) -> Camera:
        scale = min(scene.image_scale, image_scale_for(camera.width, camera.height, MOST_PIXELS))
        return squared(camera.scaled(scale))

    poses = [small(f.camera) for f in spread(training(scene.static), OF_SWEEP)]
    cameras = film_cameras(scene)
    side = max(camera.width for camera in poses)
    path = orbit(cameras, scene.aabb, OF_FILM, film_lens(cameras, size=(side, side)))
    if motion is None:
        return poses, [(camera, None) for camera in path]
    fixed, moments = clips(scene), []
    for clip in fixed.values():
        moments += [(small(f.camera), f.time) for f in spread(clip, max(2, OF_MOTION // len(fixed)))]
    # neighbours on the path are at times far apart, so that each part of it sees all of the motion
    times = (np.arange(OF_FILM) * 5 % OF_FILM + 0.5) / OF_FILM
    return poses, moments + [(camera, float(t)) for camera, t in zip(path, times, strict=True)]


def squared(camera: Camera) -> Camera:
    """The camera without lens distortion, and as high as it is wide: windows show more than a camera's picture."""
    side = max(camera.width, camera.height)
    K = camera.K.copy()
    K[:2, 2] += (side - camera.width) / 2, (side - camera.height) / 2
    return Camera(side, side, K, camera.cam_from_world)


def rest_time(motion: MotionField) -> float | None:
    """The time of [0, 1] that counts as that of rest; None if there is none."""
    return None if motion.rest_key is None else motion.key_times[motion.rest_key]


@torch.no_grad()
def look(model: DynamicModel, camera: Camera, time: float | None, coded: Shell | None) -> PlacedView:
    """A picture of what rests at a time, and where its pixels lie: in the box where it is solid, else in the
    surroundings (`coded_shell`)."""
    device = str(model.rest.canonical.density.device)
    view = seen.look(model, camera, time)
    size = (camera.height, camera.width, 3)
    points = torch.from_numpy(view.points.astype(np.float32)).to(device)
    is_body = points.isfinite().all(-1)
    points[~torch.from_numpy(view.kept).to(device)] = torch.nan
    if coded is not None:
        front, left, back = _surroundings(coded, model.rest.near_for(camera), *camera_rays(camera, device))
        points = torch.where(is_body[..., None], points, back.reshape(size))
        hidden = (left < 1 - SOLID).reshape(size[:2])
        points, is_body = torch.where(hidden[..., None], front.reshape(size), points), is_body & ~hidden
    return PlacedView(camera, None, torch.from_numpy(view.picture).to(device), points, is_body)


def coded_shell(shell: Shell) -> Shell:
    """Surroundings with their contracted places for colours: rendered, they say where what is seen lies."""
    y = vertices(CUBE, (shell.size, shell.size, shell.size)).to(shell.grid)
    grid = torch.cat([shell.grid[..., :1], torch.logit((y / EDGE + 1) / 2)], dim=-1)
    coded = Shell(shell.aabb, grid, shell.final, shell.near, shell.contraction)
    coded.distance = shell.distance
    return coded


def _surroundings(
    coded: Shell, near: float, rays_o: Float[Tensor, "R 3"], rays_d: Float[Tensor, "R 3"]
) -> tuple[Float[Tensor, "R 3"], Float[Tensor, " R"], Float[Tensor, "R 3"]]:
    """Mean places of what rays see before the box, how much light that lets through, and of what is behind it."""
    t_in, t_out, _ = intersect(rays_o, rays_d, coded.aabb, near)
    middle = torch.full_like(t_in, 0.5)
    lo, hi = coded.aabb.to(rays_o)

    def world(code: Tensor) -> Tensor:
        return expand((code * 2 - 1) * EDGE, coded.contraction) * (hi - lo) / 2 + (lo + hi) / 2

    before = RaySegments(rays_o, rays_d, torch.full_like(t_in, near), t_in, middle)
    front, left, _ = coded.render(before, False)
    back, _, _ = coded.render(RaySegments(rays_o, rays_d, t_out, t_out, middle), True)
    return world(front / (1 - left).clamp(min=1e-6)[:, None]), left, world(back)


def _still(movers: Movers) -> Movers:
    """The same if nothing moved, in the same light."""
    turns = torch.eye(3).expand_as(movers.rotations).contiguous()
    return replace(movers, rotations=turns, shifts=torch.zeros_like(movers.shifts), stretches=None)
