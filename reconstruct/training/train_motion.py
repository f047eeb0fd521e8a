"""Stage 2: learn how the scene moves, from the moving cameras, the scene at rest held fixed (DeVRF 3.2-3.3).

Coarse to fine: at each level of the pyramid the key times are visited in order, away from the time of rest, and
each key's two grids are trained alone on the pictures around its time, with a fresh Adam. At the first level a key
starts from the one before it, which tracks the motion through time; later levels start from their own, refined.
A ray's own time lies between two keys and is interpolated; the neighbours are held fixed meanwhile.

The published program takes the pixels of one camera in each step, the cameras in turn, all pixels alike: preset
`reference` does so, the others take all cameras at once and mostly pixels that change. Departures: exact times
instead of one picture per key; what is empty is skipped; a motion out of the box leads to empty space instead of
fog; the first key is not trained twice (the program's slot 0 falls to it).
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import Progress, no_progress
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.key_pictures import KeyPictures
from devrf.reconstruct.adapt.key_times import fewer_keys, offered_keys, rest_key_of
from devrf.reconstruct.adapt.motion_box import motion_box
from devrf.reconstruct.adapt.sizing import Decision, levels_for
from devrf.reconstruct.adapt.static_keys import still_beyond_rest, still_keys
from devrf.reconstruct.evaluation.left_out import LeftOut
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import BETAS, EPS
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.kernels.adam import add_total_variation, dense_step
from devrf.reconstruct.kernels.quad import quad
from devrf.reconstruct.options import REFERENCE_EXTENT, MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel, live_distance, render_moved
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.checked_flow import CheckedFlow, checked_flow
from devrf.reconstruct.sampling.moving_pixels import changing_pixels, draw_with_importance
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.sampling.pixel_flow import PixelFlow
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint, Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.guard import LOOK_EVERY, Guard, diverged
from devrf.reconstruct.training.losses import (
    VARIATION_CLAMP,
    cycle_loss,
    entropy_loss,
    flow_loss,
    per_point_loss,
    rendering_loss,
    variation_weight,
)

LOG_EVERY = 50
LIVE_EVERY = (
    10  # iterations between rebuilds of where the moving scene may be; 3 voxels more cover its way meanwhile
)
PUBLISHED_RAYS = 8192  # by which variation is weighted, whatever is drawn
JUDGED = 512  # rays by which it is seen whether a key has become worse: the same before and after
WORSE = 1.26  # 1 dB: by how much worse a key may fit them than before; steps a third as large do a third of the harm
ROUNDED = 1 / (12 * 255**2)  # variance of rounding to 8 bits: smaller errors do not compare


def train_motion(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
    checkpoint: Checkpoint = NOWHERE,
    watch: Watch | None = None,
    leave_out: bool = False,
) -> tuple[MotionField, dict]:
    """Train both motion fields; returns them and what the training measured.

    Args:
        scene: Its moving cameras are trained on.
        rest: The scene at rest; stays as it is.
        flows: Backward flow by camera; may be empty.
        options: What can be chosen.
        device: cpu or cuda.
        progress: Told how far it is.
        checkpoint: Where to keep the state between two key times, and to take it up from.
        watch: Shown the motion field now and then, between two key times.
        leave_out: Leave out the pixels by which the field is compared with movers (`left_out.py`).
    Raises:
        ReconstructError: No training pictures of the scene in motion, or the loss diverges with small steps, too.
    """
    scene = scene.in_box_frame()
    frames = training(scene.dynamic)
    if not frames:
        raise ReconstructError("pictures-none", "no training pictures of the scene in motion")
    log = TrainingLog(device, LOG_EVERY)
    rays = RaySet(frames, scene.image_scale, scene.background, device, lambda f, m: progress(0.03 * f, m))
    checked = checked_flow(rays, flows) if options.flow_confidence else CheckedFlow(flows, {})
    recipe = _Recipe(scene, rest, rays, checked, options, device, leave_out)
    visits = [(level, key) for level in range(len(options.levels)) for key in recipe.order]
    saved = checkpoint.found(log)
    begin = 0 if saved is None else recipe.take_up(saved)
    total = sum(options.iterations) * (len(recipe.order) - len(recipe.still))
    for n, (level, key) in enumerate(visits[begin:], begin):
        if level != recipe.level:
            recipe.enter_level(level)
        if key in recipe.still:
            recipe.follow(key)
            continue
        recipe.enter_key(key)
        while not recipe.train_key(log):
            if not recipe.go_back(log):
                break
        recipe.leave_key()
        last = f", PSNR {log.rows[-1]['psnr']:.1f} dB" if log.rows else ""
        progress(min(1.0, 0.05 + 0.95 * log.iteration / total), f"level {level + 1}, key {key}{last}")
        checkpoint.keep(n + 1, len(visits), log, recipe.state)
        if watch is not None:
            watch(log, lambda: recipe.motion)
    log.close_row()
    left_box, seen = recipe.looked_up.tolist()
    metrics = log.summary() | {
        "keys": recipe.motion.keys,
        "grid": list(recipe.motion.backward.shape[1:4]),
        "pictures": len(frames),
        "left_box_share": left_box / max(1, seen),
        "largest_motion": max(float(key.norm(dim=-1).max()) for key in recipe.motion.forward),
        "flow_pictures": recipe.flow.pictures,
        "flow_contradicted": recipe.flow_contradicted,
        "decisions": [str(decision) for decision in recipe.decisions],
        "keys_left": recipe.keys_left,
        **recipe.guard.summary(),
    }
    return recipe.motion, metrics


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
        checked: CheckedFlow,
        options: MotionOptions,
        device: str,
        leave_out: bool,
    ) -> None:
        looked_at = rest.canonical.seen_with(
            options.stepsize, options.alpha_threshold, options.weight_threshold
        )
        self.rest, self.rays = replace(rest, canonical=looked_at), rays
        self.decisions: list[Decision] = []
        self.options = options = levels_for(options, rest.canonical) if options.adapt else options
        self.generator = torch.Generator().manual_seed(options.seed)
        flows, self.flow_contradicted = checked.flows, checked.contradicted
        self.around = PixelSurroundings(DynamicModel(rest), rays)
        self.flow = PixelFlow(rays, flows, options.flow_confidence)
        self.changing = changing_pixels(rays, flows) if options.importance > 0 else None
        self.left_out = LeftOut(rays, self.changing) if leave_out else None
        times = sorted({f.time for f in rays.frames if f.time is not None})
        keys = offered_keys(rays.frames, options)
        if options.adapt and options.keys is None:
            keys, decision = fewer_keys(flows, keys)
            self._note(decision)
        box = motion_box(scene, rest, rays.frames, len(times))
        self.motion = MotionField.still(
            box,
            keys,
            options.levels[0],
            t_first=times[0],
            t_last=times[-1],
            rest_key=None if scene.rest_time is None else rest_key_of(scene.rest_time, times, keys),
            device=device,
        )
        after = 0 if self.motion.rest_key is None else self.motion.rest_key + 1
        self.order = [*range(after, keys), *range(after - 2, -1, -1)]  # from the rest on, and back from it
        self.tau_of_frame = self.motion.tau(rays.times)
        names = [f.camera_name for f in rays.frames]
        self.key_pictures = KeyPictures(names, self.tau_of_frame, keys)
        extent = box[1] - box[0]
        # Published units per unit of the box frame; in normalised device coordinates they are the same.
        self.unit = 1.0 if rest.canonical.ndc is not None else REFERENCE_EXTENT / float(extent.max())
        # Samples that the motion led out of the box, and all: asked for at the end, since a GPU would be waited for.
        self.looked_up = torch.zeros(2, dtype=torch.int64, device=device)
        self.guard = Guard()
        self.keys_left = 0  # as they were before, because training made them worse
        self.level, self.key, self.step_of_key = 0, 0, 0
        self.direction = 1  # from the key before to the present one
        self.device = device
        self.still = still_beyond_rest(rays, self.tau_of_frame, keys, self.motion.rest_key)
        if options.adapt or options.importance > 0:
            still, decision = still_keys(rays, self.tau_of_frame, self.order, self.motion.rest_key)
            if options.adapt or len(still) == len(self.order):
                self.still |= still
                self._note(decision)

    def _note(self, decision: Decision | None) -> None:
        """Keep a decision, where what the preset offers was not taken."""
        if decision is not None:
            self.decisions.append(decision)

    @property
    def lr(self) -> float:
        """Learning rate of the present level."""
        levels = len(self.options.levels)
        lr = self.options.learning_rate * self.options.lr
        return self.guard.rate * lr / self.unit * 0.1 ** (self.level / max(1, levels - 1))

    def state(self) -> State:
        """Everything that the next key depends on."""
        tensors = {
            "backward": self.motion.backward,
            "forward": self.motion.forward,
            "generator": self.generator.get_state(),
            "looked_up": self.looked_up,
        }
        numbers: dict[str, Any] = {name: getattr(self, name) for name in ("level", "keys_left")}
        numbers["guard"] = self.guard.state()
        numbers["motion"] = self.motion.numbers() | {"aabb": self.motion.aabb.tolist()}  # to look at it
        return tensors, numbers

    def take_up(self, saved: Saved) -> int:
        """Go on from a `state`; returns how many keys of how many levels it has behind it."""
        done, tensors, numbers = saved
        self.guard.take_up(numbers.pop("guard"))
        numbers.pop("motion", None)
        for name, value in numbers.items():
            setattr(self, name, value)
        fields = {name: tensors[name] for name in ("backward", "forward")}
        self.motion = replace(self.motion, **fields).stored(self.device)
        self.generator.set_state(tensors["generator"])
        self.looked_up.copy_(tensors["looked_up"])
        return done

    def enter_level(self, level: int) -> None:
        """Refine the field; the rate follows the level."""
        self.level = level
        self.motion = self.motion.refined(self.options.levels[level], self.device)

    def enter_key(self, key: int) -> None:
        """Begin to train one key: its pictures, its starting point, a fresh Adam."""
        self.direction = self._direction(key)
        motion, before = self.motion, key - self.direction
        if self.level == 0 and 0 <= before < motion.keys:
            motion.backward[key] = motion.backward[before]
            motion.forward[key] = motion.forward[before]
        choose = self.key_pictures.around if self.level else self.key_pictures.tracked
        self.pictures = choose(key, self.direction)
        self.views = self.key_pictures.by_camera(self.pictures)
        looked_at = self.tau_of_frame[torch.cat([self.pictures, self.flow.previous[self.pictures].cpu()])]
        self.first = max(0, min(int(looked_at.min()), key - 1))
        last = max(int(looked_at.max().ceil()), key, self.first + 1)
        self.window = motion.window(self.first, last, self.device)
        self.key = key - self.first
        self.begun = [field[self.key].clone() for field in (self.window.backward, self.window.forward)]
        self.counted = self.looked_up.clone()
        self.judged = self._drawn(JUDGED, torch.Generator().manual_seed(self.options.seed))
        self.error_before = max(float(self._errors(self.judged).mean()), ROUNDED)
        cameras = len(self.views) if self.options.one_camera else 1
        self.guard.look_every = cameras * -(-LOOK_EVERY // cameras)  # whole rounds of them
        self.guard.other_part()
        self._begin()

    def _begin(self) -> None:
        """No step yet: a fresh Adam."""
        self.adam = [_Moments.of(self.window.backward), _Moments.of(self.window.forward)]
        self.live: Tensor | None = None
        self.step_of_key = 0
        self.guard.begin(self.error_before)

    def train_key(self, log: TrainingLog) -> bool:
        """All steps of the present key; whether it fits its pictures no worse than before.

        Losses of small batches, of one camera each, double by chance; the same rays as before say whether it is true.
        """
        labels = {"level": float(self.level), "key": float(self.first + self.key)}
        for _ in range(self.options.iterations[self.level]):
            if self.guard.ran_away(log, self.options.rays, self.step(), **labels) and not self._fits():
                return False
        return self._fits()

    def _fits(self) -> bool:
        """Whether the key's motion is all numbers, and not clearly worse than the one that would be gone back to."""
        fields = (self.window.backward[self.key], self.window.forward[self.key])
        if not all(bool(field.isfinite().all()) for field in fields):
            return False
        return float(self._errors(self.judged).mean()) <= WORSE**self.guard.shrunk * self.error_before

    def go_back(self, log: TrainingLog) -> bool:
        """To the key as it was; False if it has been tried with steps that are small enough, and stays so.

        Raises:
            ReconstructError: Its pictures make no number of it, without any step.
        """
        where = f"motion, level {self.level + 1}, key {self.first + self.key}"
        if not math.isfinite(self.error_before):
            raise diverged(f"the loss of the {where} is not a number")
        for field, begun in zip((self.window.backward, self.window.forward), self.begun, strict=True):
            field[self.key] = begun
        self.looked_up.copy_(self.counted)
        again = self.guard.go_back(log, where)
        self.keys_left += not again
        self._begin()
        return again

    def follow(self, key: int) -> None:
        """A key at which nothing has changed: its motion is that of the key before."""
        for field in (self.motion.backward, self.motion.forward):
            field[key] = field[key - self._direction(key)]

    def _direction(self, key: int) -> int:
        """1 where a key follows the one before it in time, -1 where it leads back from the rest."""
        rest_key = self.motion.rest_key
        return 1 if rest_key is None or key >= rest_key else -1

    def leave_key(self) -> None:
        """Keep what has been learned, where the window is a copy."""
        for whole, part in (
            (self.motion.backward, self.window.backward),
            (self.motion.forward, self.window.forward),
        ):
            if whole.device != part.device:
                whole[self.first + self.key] = part[self.key].to(whole.device)

    def step(self) -> dict[str, Tensor]:
        """One iteration on the present key; returns the unweighted losses."""
        o, motion, key = self.options, self.window, self.key
        batch = self._draw()
        tau = self._tau(batch.frame)
        if self.live is None or self.step_of_key % LIVE_EVERY == 0:
            taus = self._tau(self.pictures).unique()
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
        weight = variation_weight(o.variation, motion.backward.shape[1:4], PUBLISHED_RAYS) * self.unit**2
        for values, adam in ((motion.backward, back), (motion.forward, forth)):
            if weight > 0:
                add_total_variation(values[key], adam.grad[0], weight, VARIATION_CLAMP / self.unit)
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
        self.looked_up += torch.stack([seen.samples.left_box, seen.samples.seen])
        return parts

    def _tau(self, frames: Int[Tensor, " f"]) -> Float[Tensor, " f"]:
        """Times of pictures, in key spacings from the window's first; while tracking, never past the key."""
        tau = self.tau_of_frame[frames] - self.first
        if self.level:
            return tau
        return tau.clamp(max=self.key) if self.direction > 0 else tau.clamp(min=self.key)

    def _draw(self) -> RayBatch:
        n = self.options.rays
        if self.options.one_camera:
            pictures = self.views[self.step_of_key % len(self.views)]
            return self._kept(self.rays.draw(n, self.generator, pictures))
        return self._drawn(n, self.generator)

    def _drawn(self, n: int, generator: torch.Generator) -> RayBatch:
        """Rays of all pictures of the present key."""
        share = self.options.importance
        drawn = draw_with_importance(self.rays, self.changing, n, share, self.pictures, generator)
        return self._kept(drawn)

    def _kept(self, batch: RayBatch) -> RayBatch:
        """A batch without the pixels that are left out."""
        return batch if self.left_out is None else self.left_out.without(batch)

    @torch.no_grad()
    def _errors(self, batch: RayBatch) -> Float[Tensor, "n 3"]:
        """Squared errors of rays of the present key, as its motion is."""
        tau = self._tau(batch.frame)
        live = live_distance(self.rest, self.window, tau.unique(), 1)
        middle = torch.full_like(tau, 0.5)
        seen = render_moved(self.rest, self.window, live, batch.rays_o, batch.rays_d, tau, middle)
        rgb = self.around.at(batch.frame, batch.pixel).compose(seen.rgb, seen.left)
        return (rgb - batch.rgb) ** 2

    def _flow_loss(self, batch: RayBatch, ray_id: Tensor, x0: Tensor, weights: Tensor) -> Tensor:
        if self.options.flow == 0 or not self.flow.pictures:
            return x0.new_zeros(())
        target, previous, confidence, agreement = self.flow.at(batch.frame, batch.pixel)
        was = self.window.from_rest(x0, self._tau(previous)[ray_id])
        if self.rest.canonical.ndc is not None:
            was = self.rest.canonical.ndc.to_world(was)
        moved = self.flow.project(was, batch.frame[ray_id])
        return flow_loss(moved, target[ray_id], weights, confidence[ray_id], agreement[ray_id])
