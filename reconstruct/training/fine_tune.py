"""The scene at rest fine-tuned on the moving cameras' pictures too, once its motion is known.

The paper leaves the scene at rest as the sweep showed it, and names that as a limitation: shading changes as things
move, and what was hidden at rest keeps whatever colour it was left with. Here the motion stays and density, features
and MLP follow the pictures of all times at once, and the sweep's. The result is for pictures in motion; pictures of
the scene at rest are still made of what the sweep alone has taught.
"""

import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.adapt.sizing import Decision, levels_for
from devrf.reconstruct.evaluation.left_out import LeftOut
from devrf.reconstruct.evaluation.left_out_errors import Errors
from devrf.reconstruct.evaluation.paired import gain_text
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.fields.grids import GridTrainer
from devrf.reconstruct.fields.motion import MotionField
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rendering.model import (
    NOT_TRAINED,
    DynamicModel,
    MovedGrads,
    live_distance,
    render_moved,
)
from devrf.reconstruct.rendering.pixel_background import PixelSurroundings
from devrf.reconstruct.rendering.rays import RayBatch, Rays, RaySet
from devrf.reconstruct.rendering.render import plain_of, render_rest
from devrf.reconstruct.sampling.moving_pixels import changing_pixels, draw_with_importance
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, net_state, take_up_grids, take_up_net
from devrf.reconstruct.training.loop import ON_CPU, Step, Training, TrainingRun, train
from devrf.reconstruct.training.losses import entropy_loss, rendering_loss

PAYS_DB = 0.1  # a smaller gain, be it no chance, is not worth another model at rest
LR = 0.03  # initial, of the grids; a tenth of training's: the scene at rest is nearly right; falls by 10
NET_SHARE = 1 / 300  # the MLP's rate, of the grids'
ENTROPY = 1e-3  # weight
AT_ONCE = 1 << 14  # rays left out
REACH = 2  # voxels of the scene at rest around where the moving scene may be
TAUS_PER_KEY = 4  # times between two keys at which it is looked where that is
PICTURES = 32  # of which an iteration's rays are
MOST_MOVED = 1 << 28  # bytes of both fields that are brought to a GPU at once, where they are not kept there
WINDOW_EVERY = 10  # iterations with the same key times: to bring others costs as much as a few of them
LOG_EVERY = 50


@dataclass(frozen=True)
class FineTuned:
    """What came of fine-tuning.

    Attributes:
        model: The scene at rest as it looks in motion; None where that gains nothing.
        gain_db: On pixels that it leaves out, but its motion was trained on; None where there are none.
        decision: Why there is no model.
        metrics: What the training measured.
    """

    model: RestModel | None
    gain_db: float | None
    decision: Decision | None
    metrics: dict[str, Any]


def fine_tune(
    scene: Scene, rest: RestModel, motion: MotionField, options: MotionOptions, run: TrainingRun = ON_CPU
) -> FineTuned:
    """Train a copy of the scene at rest for `fine_tuning` iterations.

    Args:
        scene: Its moving cameras and its sweep are trained on.
        rest: The scene at rest; stays as it is.
        motion: Stays as it is.
        options: What can be chosen.
        run: Where, and who is told.
    Raises:
        ReconstructError: The loss diverges with small steps, too.
    """
    options = levels_for(options, rest.canonical) if options.adapt else options
    log = TrainingLog(run.device, LOG_EVERY)
    recipe = _Recipe(scene.in_box_frame(), rest, motion, options, run.device)
    train(recipe, log, run)
    model = recipe.model()
    before, after, decision = recipe.errors_before, recipe.errors(), None
    gain_db = after.gain_db(before) if before is not None and after is not None else None
    if options.adapt and before is not None and after is not None:
        gain = after.gain_over(before)
        if gain.side() <= 0 or gain.mean < PAYS_DB:
            reason = f"on pixels that it left out it gained {gain_text(gain)}"
            decision = Decision("fine-tuning", "none", f"{recipe.iterations} iterations", reason)
            model = None
    return FineTuned(model, gain_db, decision, log.summary() | recipe.guard.summary())


class _Recipe(Training):
    """The state of fine-tuning: the copy that is trained, its optimisers, and one iteration."""

    name = "fine-tuning"

    def __init__(
        self, scene: Scene, rest: RestModel, motion: MotionField, options: MotionOptions, device: str
    ) -> None:
        super().__init__(options.fine_tuning, torch.Generator().manual_seed(options.seed))
        self.rays, self.rays_at_rest = (
            RaySet(training(frames), scene.image_scale, scene.background, device)
            for frames in (scene.dynamic, scene.static)
        )
        self.changing = changing_pixels(self.rays) if options.importance > 0 else None
        self.left_out = LeftOut(self.rays, self.changing)
        self.around = PixelSurroundings(DynamicModel(rest), self.rays)
        self.begun = rest
        self.rest, self.whole_motion = replace(rest, canonical=_copied(rest.canonical)), motion
        self.tau, self.device = motion.tau(self.rays.times), device
        self.plain, self.options = plain_of(rest.background, device), options
        canonical = self.rest.canonical
        reachable = canonical.reachable()
        self.density, self.features = GridTrainer(canonical.density), GridTrainer(canonical.features)
        self.grids = {"density": self.density, "features": self.features}
        for grid in self.grids.values():
            grid.visit(reachable)
        self.net = FlatAdam(canonical.net)
        self.windows = _windows(motion, device)
        self.errors_before = self.errors()  # and its last window is entered

    def enter(self, window: int) -> None:
        """Take some of the key times, all if they fit, and the pictures between them."""
        self.window = window
        self.first, last = self.windows[window]
        self.motion = self.whole_motion.window(self.first, last, self.device)
        inside = (self.tau >= self.first) & (self.tau <= last)
        self.pictures = inside.nonzero()[:, 0]
        taus = (TAUS_PER_KEY * (self.tau[inside] - self.first)).round().unique() / TAUS_PER_KEY
        self.live = live_distance(self.rest, self.motion, taus, REACH) if len(taus) else None

    def step(self, iteration: int) -> Step:
        """One iteration, on rays of both kinds; the losses are of those in motion."""
        o = self.options
        if len(self.windows) > 1 and iteration % WINDOW_EVERY == 0:
            self.enter(int(torch.randint(len(self.windows), (1,), generator=self.generator)))
            self.guard.turn_to(str(self.window))
        grads = (self.density.grad[0], self.features.grad[0])
        parts = {}
        if len(self.pictures):
            batch = self._draw()
            rgb, left = self._seen(batch, self._jitter(1, batch)[0], MovedGrads(None, 0, *grads))
            parts = {"mse": rendering_loss(rgb, batch.rgb), "entropy": entropy_loss(left)}
            (parts["mse"] + ENTROPY * parts["entropy"]).backward()
        batch = self.rays_at_rest.draw(o.rays, self.generator)
        rays = Rays(batch.rays_o, batch.rays_d, self.rest.near, self._jitter(2, batch))
        behind = self.plain if self.rest.shell is None else self.rest.shell
        out = render_rest(self.rest.canonical, behind, rays, grads=(*grads, None))
        parts_at_rest = rendering_loss(out.rgb, batch.rgb), entropy_loss(out.left)
        (parts_at_rest[0] + ENTROPY * parts_at_rest[1]).backward()
        lr = self.guard.rate * o.learning_rate * LR * 0.1 ** (iteration / o.fine_tuning)
        self.features.update(lr, flag=self.density.grad[0])
        self.density.update(lr)
        self.net.step(NET_SHARE * lr)
        return Step(2 * o.rays, parts | {"mse_at_rest": parts_at_rest[0]})

    def state(self) -> State:
        """Everything that the next iteration depends on."""
        return net_state(self.net) | grids_state(self.grids), {"window": self.window}

    def go_back(self) -> int:
        """To the scene at rest as the sweep has taught it."""
        canonical, begun = self.rest.canonical, self.begun.canonical
        canonical.density.copy_(begun.density)
        canonical.features.copy_(begun.features)
        canonical.net.load_state_dict(begun.net.state_dict())
        for grid in self.grids.values():
            grid.forget()
        self.net.forget()
        return 0

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""
        _, tensors, numbers = saved
        take_up_grids(self.grids, tensors)
        take_up_net(self.net, tensors)
        self.enter(numbers["window"])

    def model(self) -> RestModel:
        """As it is now; what is empty is looked at again."""
        canonical = self.rest.canonical
        canonical.rebuild_occupancy(canonical.distance == 0)
        for parameter in canonical.net.parameters():
            parameter.requires_grad_(False)
        return replace(self.rest, shell=None, metrics={})

    @torch.no_grad()
    def errors(self) -> Errors | None:
        """Of pixels of the moving cameras that are left out; None where there are none."""
        asked, squared = [], []
        for window in range(len(self.windows)):
            self.enter(window)
            batch = self.left_out.rays_of(self.pictures)
            if batch is None:
                continue
            for frame, pixel in zip(batch.frame.split(AT_ONCE), batch.pixel.split(AT_ONCE), strict=True):
                some = self.rays.at(frame, pixel)
                rgb, _ = self._seen(some, torch.full_like(some.time, 0.5), NOT_TRAINED)
                asked.append(frame)
                squared.append(((rgb - some.rgb).double() ** 2).mean(1))
        return Errors.of(self.rays, torch.cat(asked), torch.cat(squared)) if asked else None

    def _draw(self) -> RayBatch:
        """Rays of some of the pictures, without those left out."""
        chosen = torch.randperm(len(self.pictures), generator=self.generator)[:PICTURES]
        pictures = self.pictures[chosen.to(self.pictures.device)]
        o = self.options
        return self.left_out.without(
            draw_with_importance(self.rays, self.changing, o.rays, o.importance, pictures, self.generator)
        )

    def _seen(self, batch: RayBatch, jitter: Tensor, grads: MovedGrads) -> tuple[Tensor, Tensor]:
        """Colours of rays in motion, and the box's transmittance."""
        assert self.live is not None  # there are pictures
        tau = self.tau[batch.frame] - self.first
        rays = Rays(batch.rays_o, batch.rays_d, self.rest.near, jitter)
        seen = render_moved(self.rest.canonical, self.motion, self.live, rays, tau, grads)
        return self.around.at(batch.frame, batch.pixel).compose(seen.rgb, seen.left), seen.left

    def _jitter(self, rows: int, batch: RayBatch) -> Tensor:
        return torch.rand(rows, len(batch.rgb), generator=self.generator).to(batch.rgb)


def _windows(motion: MotionField, device: str) -> list[tuple[int, int]]:
    """First and last key times of runs that together are all; one where the fields are on the device already."""
    if motion.backward.device.type == torch.device(device).type:
        return [(0, motion.keys - 1)]
    steps = max(1, MOST_MOVED // (2 * motion.backward[0].nbytes) - 1)
    return [(first, min(first + steps, motion.keys - 1)) for first in range(0, motion.keys - 1, steps)]


def _copied(canonical: Canonical) -> Canonical:
    """A model of its own, whose MLP can be trained."""
    own = copy.copy(canonical)
    own.density, own.features = canonical.density.clone(), canonical.features.clone()
    own.net = copy.deepcopy(canonical.net)
    for parameter in own.net.parameters():
        parameter.requires_grad_(True)
    return own
