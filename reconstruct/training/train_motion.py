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

import torch
from jaxtyping import Float, Int
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import part
from devrf.flow.store import CameraFlow
from devrf.reconstruct.adapt.key_pictures import KeyPictures
from devrf.reconstruct.adapt.key_times import fewer_keys, offered_keys, rest_key_of
from devrf.reconstruct.adapt.motion_box import motion_box
from devrf.reconstruct.adapt.sizing import Decision, levels_for
from devrf.reconstruct.adapt.static_keys import still_beyond_rest, still_keys
from devrf.reconstruct.evaluation.left_out import LeftOut
from devrf.reconstruct.fields.canonical import seen_with
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.grids import BETAS, EPS
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.kernels.adam import add_total_variation, dense_step
from devrf.reconstruct.kernels.quad import quad
from devrf.reconstruct.options import REFERENCE_EXTENT, MotionOptions
from devrf.reconstruct.rendering.model import DynamicModel, MovedGrads, live_distance, render_moved
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RayBatch, Rays, RaySet
from devrf.reconstruct.sampling.checked_flow import CheckedFlow, checked_flow
from devrf.reconstruct.sampling.moving_pixels import changing_pixels, draw_with_importance
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.sampling.pixel_flow import PixelFlow
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.training.guard import LOOK_EVERY, diverged
from devrf.reconstruct.training.loop import ON_CPU, Training, TrainingRun, train
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
# Iterations between rebuilds of where the moving scene may be; 3 voxels more cover its way meanwhile.
LIVE_EVERY = 10
PUBLISHED_RAYS = 8192  # by which variation is weighted, whatever is drawn
JUDGED = 512  # rays by which it is seen whether a key has become worse: the same before and after
WORSE = 1.26  # 1 dB: by how much worse a key may fit them than before; steps a third as large do a third of the harm
ROUNDED = 1 / (12 * 255**2)  # variance of rounding to 8 bits: smaller errors do not compare


def train_motion(
    scene: Scene,
    rest: RestModel,
    flows: dict[str, CameraFlow],
    options: MotionOptions,
    run: TrainingRun = ON_CPU,
    leave_out: bool = False,
) -> tuple[MotionField, dict]:
    """Train both motion fields; returns them and what the training measured.

    Args:
        scene: Its moving cameras are trained on.
        rest: The scene at rest; stays as it is.
        flows: Backward flow by camera; may be empty.
        options: What can be chosen.
        run: Its state is kept between two key times, and its `watch` is shown the motion field.
        leave_out: Leave out the pixels by which the field is compared with movers (`left_out.py`).
    Raises:
        ReconstructError: No training pictures of the scene in motion, or the loss diverges with small steps, too.
    """
    scene = scene.in_box_frame()
    frames = training(scene.dynamic)
    if not frames:
        raise ReconstructError("pictures-none", "no training pictures of the scene in motion")
    log = TrainingLog(run.device, LOG_EVERY)
    reading = part(run.progress, 0.0, 0.03)
    rays = RaySet(frames, scene.image_scale, scene.background, run.device, reading)
    checked = checked_flow(rays, flows) if options.flow_confidence else CheckedFlow(flows, {})
    recipe = _Recipe(scene, rest, rays, checked, options, log)
    recipe.left_out = LeftOut(rays, recipe.changing) if leave_out else None
    train(recipe, log, run)
    left_box, seen = recipe.looked_up.tolist()
    metrics = log.summary() | {
        "keys": recipe.motion.keys,
        "grid": list(recipe.motion.backward.shape[1:4]),
        "pictures": len(frames),
        "left_box_share": left_box / max(1, seen),
        "largest_motion": max(float(key.norm(dim=-1).max()) for key in recipe.motion.forward),
        "flow_pictures": recipe.flow.pictures,
        "flow_contradicted": checked.contradicted,
        "decisions": [str(decision) for decision in recipe.decisions],
        "keys_left": recipe.keys_left,
        **recipe.guard.summary(),
    }
    return recipe.motion, metrics


class _Recipe(Training):
    """The state of stage 2: the field, and what all keys are trained with. A step is a visit of one key."""

    name = "motion"
    tell_every = 1
    left_out: LeftOut | None

    def __init__(
        self,
        scene: Scene,
        rest: RestModel,
        rays: RaySet,
        checked: CheckedFlow,
        options: MotionOptions,
        log: TrainingLog,
    ) -> None:
        looked_at = seen_with(
            rest.canonical, options.stepsize, options.alpha_threshold, options.weight_threshold
        )
        self.rest, self.rays, self.log = replace(rest, canonical=looked_at), rays, log
        self.options = options = levels_for(options, rest.canonical) if options.adapt else options
        flows, self.device = checked.flows, str(rays.device)
        self.around = PixelSurroundings(DynamicModel(rest), rays)
        self.flow = PixelFlow(rays, flows, options.flow_confidence)
        self.changing = changing_pixels(rays, flows) if options.importance > 0 else None
        times = sorted({f.time for f in rays.frames if f.time is not None})
        keys, decisions = offered_keys(rays.frames, options), []
        if options.adapt and options.keys is None:
            keys, decision = fewer_keys(flows, keys)
            decisions.append(decision)
        box = motion_box(scene, rest, rays.frames, len(times))
        rest_key = None if scene.rest_time is None else rest_key_of(scene.rest_time, times, keys)
        ends = times[0], times[-1]
        self.motion = MotionField.still(box, keys, options.levels[0], ends, rest_key, self.device)
        after = 0 if rest_key is None else rest_key + 1
        self.order = [*range(after, keys), *range(after - 2, -1, -1)]  # from the rest on, and back from it
        self.tau_of_frame = self.motion.tau(rays.times)
        names = [f.camera_name for f in rays.frames]
        self.key_pictures = KeyPictures(names, self.tau_of_frame, keys)
        extent = box[1] - box[0]
        # Published units per unit of the box frame; in normalised device coordinates they are the same.
        self.unit = 1.0 if rest.canonical.ndc is not None else REFERENCE_EXTENT / float(extent.max())
        # Samples that the motion led out of the box, and all: asked for at the end, since a GPU would be waited for.
        self.looked_up = torch.zeros(2, dtype=torch.int64, device=self.device)
        self.keys_left = 0  # as they were before, because training made them worse
        self.level = 0
        self.still = still_beyond_rest(rays, self.tau_of_frame, keys, rest_key)
        if options.adapt or options.importance > 0:
            still, decision = still_keys(rays, self.tau_of_frame, self.order, rest_key)
            if options.adapt or len(still) == len(self.order):
                self.still |= still
                decisions.append(decision)
        self.decisions: list[Decision] = [one for one in decisions if one is not None]
        self.visits = [(level, key) for level in range(len(options.levels)) for key in self.order]
        super().__init__(len(self.visits), torch.Generator().manual_seed(options.seed))

    @property
    def lr(self) -> float:
        """Learning rate of the present level."""
        levels = len(self.options.levels)
        lr = self.options.learning_rate * self.options.lr
        return self.guard.rate * lr / self.unit * 0.1 ** (self.level / max(1, levels - 1))

    def direction(self, key: int) -> int:
        """1 where a key follows the one before it in time, -1 where it leads back from the rest."""
        rest_key = self.motion.rest_key
        return 1 if rest_key is None or key >= rest_key else -1

    def step(self, iteration: int) -> None:
        """Train one key of one level; where nothing has changed, its motion is that of the key before."""
        level, key = self.visits[iteration]
        if level != self.level:
            self.level = level
            self.motion = self.motion.refined(self.options.levels[level], self.device)
        if key in self.still:
            for field in (self.motion.backward, self.motion.forward):
                field[key] = field[key - self.direction(key)]
            return
        one = _Key(self, key)
        while not one.train():
            if not one.go_back():
                break
        one.leave()

    def told(self, iteration: int, log: TrainingLog) -> tuple[float, str]:
        """How far it is, by iterations of all keys, and in words."""
        level, key = self.visits[iteration]
        last = f", PSNR {log.rows[-1]['psnr']:.1f} dB" if log.rows else ""
        total = max(1, sum(self.options.iterations) * (len(self.order) - len(self.still)))
        return min(1.0, 0.05 + 0.95 * log.iteration / total), f"level {level + 1}, key {key}{last}"

    def shown(self) -> MotionField:
        """The field so far."""
        return self.motion

    def state(self) -> State:
        """Everything that the next key depends on."""
        tensors = {
            "backward": self.motion.backward,
            "forward": self.motion.forward,
            "looked_up": self.looked_up,
        }
        return tensors, {
            "level": self.level,
            "keys_left": self.keys_left,
            "motion": self.motion.numbers() | {"aabb": self.motion.aabb.tolist()},  # to look at it
        }

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""
        _, tensors, numbers = saved
        self.level, self.keys_left = numbers["level"], numbers["keys_left"]
        fields = {name: tensors[name] for name in ("backward", "forward")}
        self.motion = replace(self.motion, **fields).stored(self.device)
        self.looked_up.copy_(tensors["looked_up"])


@dataclass
class _Moments:
    """Adam's state for one key of one field."""

    grad: Tensor
    moment1: Tensor
    moment2: Tensor

    @staticmethod
    def of(field: Tensor) -> "_Moments":
        return _Moments(*(torch.zeros_like(field[:1]) for _ in range(3)))


class _Key:
    """One key in training: its pictures, its starting point, its window of the field, a fresh Adam."""

    def __init__(self, of: _Recipe, key: int) -> None:
        self.of, self.direction = of, of.direction(key)
        motion, before, tau = of.motion, key - self.direction, of.tau_of_frame
        if of.level == 0 and 0 <= before < motion.keys:
            motion.backward[key] = motion.backward[before]
            motion.forward[key] = motion.forward[before]
        choose = of.key_pictures.around if of.level else of.key_pictures.tracked
        self.pictures = choose(key, self.direction)
        self.views = of.key_pictures.by_camera(self.pictures)
        looked_at = tau[torch.cat([self.pictures, of.flow.previous[self.pictures].cpu()])]
        self.first = max(0, min(int(looked_at.min()), key - 1))
        last = max(int(looked_at.max().ceil()), key, self.first + 1)
        self.window = motion.window(self.first, last, of.device)
        self.key = key - self.first
        self.begun = [field[self.key].clone() for field in (self.window.backward, self.window.forward)]
        self.counted = of.looked_up.clone()
        self.judged = self._drawn(JUDGED, torch.Generator().manual_seed(of.options.seed))
        self.error_before = max(float(self._errors(self.judged).mean()), ROUNDED)
        cameras = len(self.views) if of.options.one_camera else 1
        of.guard.look_every = cameras * -(-LOOK_EVERY // cameras)  # whole rounds of them
        of.guard.other_part()
        self._begin()

    def _begin(self) -> None:
        """No step yet: a fresh Adam."""
        self.adam = [_Moments.of(self.window.backward), _Moments.of(self.window.forward)]
        self.live: Tensor | None = None
        self.step_of_key = 0
        self.of.guard.begin(self.error_before)

    def train(self) -> bool:
        """All steps; whether the key fits its pictures no worse than before.

        Losses of small batches, of one camera each, double by chance; the same rays as before say whether it is true.
        """
        of = self.of
        labels = {"level": float(of.level), "key": float(self.first + self.key)}
        for _ in range(of.options.iterations[of.level]):
            if of.guard.ran_away(of.log, of.options.rays, self.step(), **labels) and not self._fits():
                return False
        return self._fits()

    def _fits(self) -> bool:
        """Whether the key's motion is all numbers, and not clearly worse than the one that would be gone back to."""
        fields = (self.window.backward[self.key], self.window.forward[self.key])
        if not all(bool(field.isfinite().all()) for field in fields):
            return False
        return float(self._errors(self.judged).mean()) <= WORSE**self.of.guard.shrunk * self.error_before

    def go_back(self) -> bool:
        """To the key as it was; False if it has been tried with steps that are small enough, and stays so.

        Raises:
            ReconstructError: Its pictures make no number of it, without any step.
        """
        of = self.of
        where = f"motion, level {of.level + 1}, key {self.first + self.key}"
        if not math.isfinite(self.error_before):
            raise diverged(f"the loss of the {where} is not a number")
        for field, begun in zip((self.window.backward, self.window.forward), self.begun, strict=True):
            field[self.key] = begun
        of.looked_up.copy_(self.counted)
        again = of.guard.go_back(of.log, where)
        of.keys_left += not again
        self._begin()
        return again

    def leave(self) -> None:
        """Keep what has been learned, where the window is a copy."""
        motion, window = self.of.motion, self.window
        for whole, mine in ((motion.backward, window.backward), (motion.forward, window.forward)):
            if whole.device != mine.device:
                whole[self.first + self.key] = mine[self.key].to(whole.device)

    def step(self) -> dict[str, Tensor]:
        """One iteration; returns the unweighted losses."""
        of, motion, key = self.of, self.window, self.key
        o, canonical = of.options, of.rest.canonical
        batch = self._draw()
        tau = self._tau(batch.frame)
        if self.live is None or self.step_of_key % LIVE_EVERY == 0:
            taus = self._tau(self.pictures).unique()
            self.live = live_distance(of.rest, motion, torch.cat([taus, taus.new_tensor([key])]), 3)
        self.step_of_key += 1
        jitter = torch.rand(len(batch.rgb), generator=of.generator).to(batch.rgb)
        back, forth = self.adam
        rays = Rays(batch.rays_o, batch.rays_d, of.rest.near, jitter)
        seen = render_moved(canonical, motion, self.live, rays, tau, MovedGrads(back.grad, key))
        around = of.around.at(batch.frame, batch.pixel)
        ray_id, x0 = seen.samples.ray_id, seen.x0
        again = x0 + quad(motion.forward, x0, tau[ray_id], motion.aabb, forth.grad, key)
        parts = {
            "mse": rendering_loss(around.compose(seen.rgb, seen.left), batch.rgb),
            "cycle": cycle_loss(seen.x * of.unit, again * of.unit),
            "flow": self._flow_loss(batch, ray_id, x0, seen.weights),
            "entropy": entropy_loss(seen.left),
            "per_point": per_point_loss(seen.weights, seen.colours, batch.rgb, ray_id),
        }
        loss = parts["mse"] + o.cycle * parts["cycle"] + o.flow * parts["flow"]
        loss = loss + o.entropy * parts["entropy"] + o.per_point * parts["per_point"]
        if loss.requires_grad:
            loss.backward()
        weight = variation_weight(o.variation, motion.backward.shape[1:4], PUBLISHED_RAYS) * of.unit**2
        for values, adam in ((motion.backward, back), (motion.forward, forth)):
            grad, moments = adam.grad[0], (adam.moment1[0], adam.moment2[0])
            if weight > 0:
                add_total_variation(values[key], grad, weight, VARIATION_CLAMP / of.unit)
            dense_step(values[key], grad, *moments, self.step_of_key, of.lr, BETAS, EPS)
        of.looked_up += torch.stack([seen.samples.left_box, seen.samples.seen])
        return parts

    def _tau(self, frames: Int[Tensor, " f"]) -> Float[Tensor, " f"]:
        """Times of pictures, in key spacings from the window's first; while tracking, never past the key."""
        tau = self.of.tau_of_frame[frames] - self.first
        if self.of.level:
            return tau
        return tau.clamp(max=self.key) if self.direction > 0 else tau.clamp(min=self.key)

    def _draw(self) -> RayBatch:
        of, n = self.of, self.of.options.rays
        if not of.options.one_camera:
            return self._drawn(n, of.generator)
        batch = of.rays.draw(n, of.generator, self.views[self.step_of_key % len(self.views)])
        return batch if of.left_out is None else of.left_out.without(batch)

    def _drawn(self, n: int, generator: torch.Generator) -> RayBatch:
        """Rays of all pictures of the key, without the pixels that are left out."""
        of, share = self.of, self.of.options.importance
        batch = draw_with_importance(of.rays, of.changing, n, share, self.pictures, generator)
        return batch if of.left_out is None else of.left_out.without(batch)

    @torch.no_grad()
    def _errors(self, batch: RayBatch) -> Float[Tensor, "n 3"]:
        """Squared errors of rays of the key, as its motion is."""
        of, tau = self.of, self._tau(batch.frame)
        live = live_distance(of.rest, self.window, tau.unique(), 1)
        rays = Rays.middle(batch.rays_o, batch.rays_d, of.rest.near)
        seen = render_moved(of.rest.canonical, self.window, live, rays, tau)
        rgb = of.around.at(batch.frame, batch.pixel).compose(seen.rgb, seen.left)
        return (rgb - batch.rgb) ** 2

    def _flow_loss(self, batch: RayBatch, ray_id: Tensor, x0: Tensor, weights: Tensor) -> Tensor:
        of, ndc = self.of, self.of.rest.canonical.ndc
        if of.options.flow == 0 or not of.flow.pictures:
            return x0.new_zeros(())
        target, previous, confidence, agreement = of.flow.at(batch.frame, batch.pixel)
        was = self.window.from_rest(x0, self._tau(previous)[ray_id])
        if ndc is not None:
            was = ndc.to_world(was)
        moved = of.flow.project(was, batch.frame[ray_id])
        return flow_loss(moved, target[ray_id], weights, confidence[ray_id], agreement[ray_id])
