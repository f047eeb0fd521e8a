"""Stage 2: learn how the scene moves, from the moving cameras, the scene at rest held fixed (DeVRF 3.2-3.3).

Coarse to fine: at each level of the pyramid the key times are visited in order, away from the time of rest, and
each key's two grids are trained alone on the pictures around its time, with a fresh Adam. At the first level a key
starts from the one before it, which tracks the motion through time; later levels start from their own, refined.
A ray's own time lies between two keys and is interpolated; the neighbours are held fixed meanwhile.

Departures from the published program: exact times instead of one picture per key; pixels drawn mostly where
pictures change (presets tiny and fast); pixels of all cameras in every step instead of one camera's.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.errors import ReconstructError
from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import PosedFrame, Scene
from devrf.flow.store import CameraFlow
from devrf.reconstruct.grids import BETAS, EPS, grid_shape
from devrf.reconstruct.hull import box_of, visual_hull
from devrf.reconstruct.kernels.adam import add_total_variation, dense_step
from devrf.reconstruct.kernels.quad import quad
from devrf.reconstruct.losses import cycle_loss, entropy_loss, flow_loss, per_point_loss, rendering_loss
from devrf.reconstruct.model import DynamicModel, live_distance, render_moved
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.moving_pixels import changing_pixels
from devrf.reconstruct.options import REFERENCE_EXTENT, MotionOptions
from devrf.reconstruct.pixel_flow import PixelFlow
from devrf.reconstruct.rays import RayBatch, RaySet
from devrf.reconstruct.surroundings import PixelSurroundings
from devrf.reconstruct.train_canonical import RestModel
from devrf.reconstruct.training_log import TrainingLog

LOG_EVERY = 50
HULL_RESOLUTION, HULL_TIMES, HULL_MARGIN = 40, 12, 1.05  # to find the box that the subject sweeps
TV_CLAMP = 1.0  # published: differences beyond one world unit pull no harder
TV_RAYS, TV_RESOLUTION = 8192, 128  # published: variation is weighted by resolution / 128 / rays


def train_motion(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
) -> tuple[MotionField, dict]:
    """Train both motion fields; returns them and what the training measured.

    Raises:
        ReconstructError: No training pictures of the scene in motion, or the loss diverged.
    """
    scene = scene.in_box_frame()
    frames = tuple(f for f in scene.dynamic if f.split == "train" and f.time is not None)
    if not frames:
        raise ReconstructError("no training pictures of the scene in motion")
    log = TrainingLog(device, LOG_EVERY)
    rays = RaySet(frames, scene.image_scale, scene.background, device, lambda f, m: progress(0.03 * f, m))
    recipe = _Recipe(scene, rest, rays, flows, options, device)
    total = sum(options.iterations) * len(recipe.order)
    for level, (resolution, iterations) in enumerate(zip(options.levels, options.iterations, strict=True)):
        recipe.enter_level(level, resolution)
        for key in recipe.order:
            recipe.enter_key(key)
            for _ in range(iterations):
                log.add(options.rays, recipe.step(), level=float(level), key=float(key))
            last = f", PSNR {log.rows[-1]['psnr']:.1f} dB" if log.rows else ""
            progress(0.05 + 0.95 * log.iteration / total, f"level {level + 1}, key {key}{last}")
    log.close_row()
    metrics = log.summary() | {
        "keys": recipe.motion.keys,
        "grid": list(recipe.motion.backward.shape[1:4]),
        "pictures": len(frames),
        "left_box_share": recipe.left_box / max(1, recipe.seen),
        "largest_motion": float(recipe.motion.forward.norm(dim=-1).max()),
        "flow_pictures": recipe.flow.pictures,
    }
    return recipe.motion, metrics


def _motion_box(
    scene: Scene, rest: RestModel, frames: tuple[PosedFrame, ...], keys: int
) -> Float[Tensor, "2 3"]:
    """The box that the subject sweeps: before a plain background the union of its hulls over time."""
    if scene.background == "shell":
        return rest.canonical.aabb
    cameras: dict[str, list[PosedFrame]] = {}
    for frame in frames:
        cameras.setdefault(frame.camera_name, []).append(frame)
    whole = torch.tensor(scene.aabb, dtype=torch.float32)
    shape = grid_shape(whole, HULL_RESOLUTION)
    swept = torch.zeros(shape, dtype=torch.bool)
    for key in range(0, keys, max(1, keys // HULL_TIMES)):
        time = key / (keys - 1)
        nearest = [min(clip, key=lambda f, t=time: abs((f.time or 0.0) - t)) for clip in cameras.values()]
        swept |= visual_hull(nearest, whole, shape, scene.background, least_seen=1.0)
    box = box_of(swept, whole, HULL_MARGIN)
    if box is None or len(cameras) < 2:
        return rest.canonical.aabb
    return torch.stack(
        [torch.minimum(box[0], rest.canonical.aabb[0]), torch.maximum(box[1], rest.canonical.aabb[1])]
    )


@dataclass
class _Moments:
    """Adam's state for one key of one field."""

    grad: Tensor
    moment1: Tensor
    moment2: Tensor

    @staticmethod
    def of(field: Tensor) -> "_Moments":
        return _Moments(*(torch.zeros_like(field[:1]) for _ in range(3)))


class _Recipe:
    """The state of stage 2: the field, what is being trained of it, and one iteration."""

    def __init__(
        self,
        scene: Scene,
        rest: RestModel,
        rays: RaySet,
        flows: dict[str, CameraFlow],
        options: MotionOptions,
        device: str,
    ) -> None:
        looked_at = rest.canonical.seen_with(
            options.stepsize, options.alpha_threshold, options.weight_threshold
        )
        self.rest, self.rays, self.options = replace(rest, canonical=looked_at), rays, options
        self.generator = torch.Generator().manual_seed(options.seed)
        self.around = PixelSurroundings(DynamicModel(rest), rays)
        self.flow = PixelFlow(rays, flows)
        self.changing = changing_pixels(rays) if options.importance > 0 else None
        times = sorted({f.time for f in rays.frames if f.time is not None})
        keys = max(2, min(options.most_keys, len(times)))
        at_start = scene.rest_time is not None and scene.rest_time <= times[0]
        at_end = scene.rest_time is not None and scene.rest_time >= times[-1] and not at_start
        box = _motion_box(scene, rest, rays.frames, keys)
        self.motion = MotionField.still(
            box,
            keys,
            options.levels[0],
            t_first=times[0],
            t_last=times[-1],
            rest_key=0 if at_start else keys - 1 if at_end else None,
            device=device,
        )
        everything = list(range(keys)) if not at_end else list(range(keys - 1, -1, -1))
        self.order = [key for key in everything if key != self.motion.rest_key]
        self.direction = -1 if at_end else 1
        self.tau_of_frame = self.motion.tau(rays.times)
        extent = box[1] - box[0]
        self.unit = REFERENCE_EXTENT / float(extent.max())  # published units per unit of the box frame
        self.left_box = self.seen = 0
        self.level, self.lr, self.key, self.step_of_key = 0, options.lr, 0, 0

    def enter_level(self, level: int, resolution: int) -> None:
        """Refine the field; lower the rate."""
        if level:
            self.motion = self.motion.refined(resolution)
        levels = len(self.options.levels)
        self.level, self.lr = level, self.options.lr / self.unit * 0.1 ** (level / max(1, levels - 1))

    def enter_key(self, key: int) -> None:
        """Begin to train one key: its pictures, its starting point, a fresh Adam."""
        before = key - self.direction
        if self.level == 0 and 0 <= before < self.motion.keys:
            self.motion.backward[key] = self.motion.backward[before]
            self.motion.forward[key] = self.motion.forward[before]
        self.key, self.step_of_key = key, 0
        self.pictures = self._pictures_around(key)
        self.adam = [_Moments.of(self.motion.backward), _Moments.of(self.motion.forward)]
        self.live: Tensor | None = None

    def step(self) -> dict[str, Tensor]:
        """One iteration on the present key; returns the unweighted losses."""
        o, motion, key = self.options, self.motion, self.key
        batch = self._draw()
        tau = self.tau_of_frame[batch.frame]
        if self.live is None or self.step_of_key % o.live_every == 0:
            taus = self.tau_of_frame[self.pictures].unique()
            self.live = live_distance(self.rest, motion, torch.cat([taus, taus.new_tensor([key])]), 3)
        self.step_of_key += 1
        jitter = torch.rand(len(batch.rgb), generator=self.generator).to(batch.rgb)
        back, forth = self.adam
        seen = render_moved(
            self.rest, motion, self.live, batch.rays_o, batch.rays_d, tau, jitter, back.grad, key
        )
        around = self.around.at(batch.frame, batch.pixel)
        ray_id, x0 = seen.samples.ray_id, seen.x0
        again = x0 + quad(motion.forward, x0, tau[ray_id], motion.aabb, forth.grad, key)
        parts = {
            "mse": rendering_loss(around.compose(seen.rgb, seen.left), batch.rgb),
            "cycle": cycle_loss(seen.x * self.unit, again * self.unit),
            "flow": self._flow_loss(batch, ray_id, x0, seen.weights),
            "entropy": entropy_loss(seen.left),
            "per_point": per_point_loss(seen.weights, seen.colours, batch.rgb, ray_id),
        }
        loss = parts["mse"] + o.cycle * parts["cycle"] + o.flow * parts["flow"]
        loss = loss + o.entropy * parts["entropy"] + o.per_point * parts["per_point"]
        if loss.requires_grad:
            loss.backward()
        resolution = max(motion.backward.shape[1:4])
        weight = o.variation * resolution / TV_RESOLUTION / TV_RAYS * self.unit**2
        for values, adam in ((motion.backward, back), (motion.forward, forth)):
            add_total_variation(values[key], adam.grad[0], weight, TV_CLAMP / self.unit)
            dense_step(
                values[key],
                adam.grad[0],
                adam.moment1[0],
                adam.moment2[0],
                self.step_of_key,
                self.lr,
                BETAS,
                EPS,
            )
        self.left_box += int(seen.samples.left_box)
        self.seen += int(seen.samples.seen)
        return parts

    def _pictures_around(self, key: int) -> Int[Tensor, " f"]:
        """Pictures that this key is trained on: up to the neighbours; while tracking, only those before it."""
        away = (self.tau_of_frame - key) * self.direction
        ahead = 1.0 if self.level else 1e-3
        for reach in (1.0, 2.0, float(self.motion.keys)):  # a dropped frame may leave a key without pictures
            chosen = ((away > -reach) & (away < max(ahead, reach - 1.0 + 1e-3))).nonzero()[:, 0]
            if len(chosen):
                return chosen
        raise ReconstructError(f"no picture near key time {key}")

    def _draw(self) -> RayBatch:
        n = self.options.rays
        chosen = round(n * self.options.importance) if self.changing is not None else 0
        batch = None
        if chosen and self.changing is not None:
            frame, pixel = self.changing.draw(chosen, self.pictures, self.generator)
            if len(frame):
                rest = self.rays.draw(n - len(frame), self.generator, self.pictures)
                batch = self.rays.at(torch.cat([frame, rest.frame]), torch.cat([pixel, rest.pixel]))
        return batch if batch is not None else self.rays.draw(n, self.generator, self.pictures)

    def _flow_loss(self, batch: RayBatch, ray_id: Tensor, x0: Tensor, weights: Tensor) -> Tensor:
        if self.options.flow == 0 or not self.flow.pictures:
            return x0.new_zeros(())
        target, previous, valid = self.flow.at(batch.frame, batch.pixel)
        tau = self.tau_of_frame[previous][ray_id]
        was = self.motion.from_rest(x0, tau)
        moved = self.flow.project(was, batch.frame[ray_id])
        return flow_loss(moved, target[ray_id], weights, valid[ray_id])
