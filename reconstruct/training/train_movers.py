"""What stands and what moves, trained together on all pictures of the moving cameras, and the motion corrected.

What stood behind a mover was never seen at rest, nor were all of its faces; both are filled in here. Tracks compare
high-pass pictures; here what all pictures say of the whole corrects where parts are. Shading takes what light does
meanwhile: without it cast shadows would be painted on what is filled in. Pictures of the scene at rest are still made
of what the sweep has taught.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.evaluation.left_out import LeftOut
from devrf.reconstruct.evaluation.left_out_errors import Errors, errors_of
from devrf.reconstruct.fields.canonical import Canonical, raw_density
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.fields.grids import GridTrainer, grown
from devrf.reconstruct.fields.movers import Movers, Placed
from devrf.reconstruct.fields.pose_corrections import Corrections
from devrf.reconstruct.fields.shading import Shading
from devrf.reconstruct.kernels.composite_layers import Fields
from devrf.reconstruct.options import MotionOptions, longer
from devrf.reconstruct.rendering.layered import draw_layered, render_layered
from devrf.reconstruct.rendering.model import Around, DynamicModel
from devrf.reconstruct.rendering.rays import RayBatch, Rays, RaySet
from devrf.reconstruct.rendering.render import RayColours
from devrf.reconstruct.sampling.moving_pictures import MovingPictures
from devrf.reconstruct.sampling.moving_pixels import draw_with_importance
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.sampling.retimed import retimed
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, net_state, take_up_grids, take_up_net
from devrf.reconstruct.training.loop import ON_CPU, Step, Training, TrainingRun, train
from devrf.reconstruct.training.losses import entropy_loss, per_point_loss, rendering_loss

PICTURES = 16  # of which an iteration's rays are
LR_FEATURES, LR_DENSITY, LR_NET, LR_SHADING = 0.1, 0.15, 3e-4, 0.03  # initial; all fall by 10
LR_PLACES = 0.03  # voxels; the same
SWEEP = 0.25  # rays of the sweep for one of the moving cameras, and their weight
ENTROPY, PER_POINT = 1e-3, 1e-2  # weights
TRAINS = 3e-3  # weight from which a sample has a colour: half of the time, and fog has one
FOG = 0.004  # opacity of a step, of what could stand where movers are
# Voxels around movers in which it could, and in which what stands may be wrong: it was hidden by them.
ZONE = 2
OCCUPANCY_EVERY = 50  # iterations
LOG_EVERY = 50


@dataclass(frozen=True)
class TrainedParts:
    """What came of it.

    Attributes:
        stands: What stands as it looks in motion, without surroundings.
        movers: What moves, and the shading.
        errors, unshaded_errors: Of changing pixels left out of training; without shading.
        errors_at_rest: Of the same, if nothing moved.
        metrics: What the training measured.
    """

    stands: RestModel
    movers: Movers
    errors: Errors
    unshaded_errors: Errors
    errors_at_rest: Errors
    metrics: dict[str, Any]


def train_movers(
    pictures: MovingPictures,
    stands: Canonical,
    movers: Movers,
    options: MotionOptions,
    run: TrainingRun = ON_CPU,
    offsets_s: Mapping[str, float] | None = None,
) -> TrainedParts:
    """Train for `together` iterations, for more where motion lasts longer than these are meant for.

    Args:
        pictures: Of a scene in the box frame, whose moving cameras are trained on; its scene at rest stays as it is.
        stands: The scene at rest without what moves.
        movers: What moves.
        options: What can be chosen.
        run: Where, and who is told.
        offsets_s: Seconds by which cameras took their pictures later than the scene says.
    Raises:
        ReconstructError: The loss diverges with small steps, too.
    """
    log = TrainingLog(run.device, LOG_EVERY)
    recipe = _Recipe(pictures, stands, movers, options, offsets_s or {})
    train(recipe, log, run)
    recipe.finish()
    return TrainedParts(
        replace(pictures.rest, canonical=recipe.stands, shell=None, metrics={}),
        recipe.movers,
        recipe.errors(recipe.movers),
        recipe.errors(recipe.movers.unshaded()),
        recipe.errors(None),
        log.summary() | recipe.guard.summary(),
    )


def untrained_errors(
    pictures: MovingPictures, stands: Canonical, motions: Sequence[Movers], options: MotionOptions
) -> list[Errors]:
    """Errors where training begins, in a little fog, of motions of the same parts, on pixels that it will leave out.

    Tracking, which gave these motions, has read the pixels. Arguments as `train_movers`'s.
    """
    recipe = _Recipe(pictures, stands, motions[0], options, {})
    moved = (
        replace(recipe.movers, rotations=m.rotations, shifts=m.shifts, stretches=m.stretches) for m in motions
    )
    return [recipe.errors(movers) for movers in moved]


class _Recipe(Training):
    """The state of the training: both layers, their optimisers, and one iteration."""

    name = "training together"

    def __init__(
        self,
        pictures: MovingPictures,
        stands: Canonical,
        movers: Movers,
        options: MotionOptions,
        offsets_s: Mapping[str, float],
    ) -> None:
        scene, rest, times = pictures.scene, pictures.rest, movers.times
        self.begun, self.keep_every = (stands, movers.canonical), OCCUPANCY_EVERY  # where it looks anew
        more = longer(float(times[-1] - times[0]) * (scene.t1_s - scene.t0_s))
        self.scene, self.options, self.rest = scene, options, rest
        super().__init__(round(more * options.together), torch.Generator().manual_seed(options.seed))
        at, self.pictures = _times(pictures.rays, scene, offsets_s)
        timed = pictures.at(at)
        self.rays, self.changing, self.around = timed.rays, timed.changing, timed.around
        self.left_out = LeftOut(self.rays, self.changing, self.pictures)
        self.at_rest = DynamicModel(rest)
        rest_time = torch.tensor([scene.rest_time or 0.0], device=self.rays.times.device)
        self.in_sweep = movers.at_rest(rest_time)
        self.corrections = Corrections(movers, self.rays.times)
        net = copy.deepcopy(stands.net)
        for parameter in net.parameters():
            parameter.requires_grad_(True)
        self.stands, own = _own(stands, net), _own(movers.canonical, net)
        ends = float(times[0]), float(times[-1])
        self.shading = Shading.none(own.aabb, *ends, own.density.device, more)
        self.movers = replace(movers, canonical=own, shading=self.shading)
        self._begin()

    @cached_property
    def sweep(self) -> RaySet:
        """Pictures of the scene at rest."""
        scene = self.scene
        return RaySet(training(scene.static), scene.image_scale, scene.background, str(self.rays.device))

    def _begin(self) -> None:
        """Fog where something could stand; fresh optimisers."""
        stands, own = self.stands, self.movers.canonical
        self.region = grown(self.movers.labels > 0)
        zone = self.region
        for _ in range(ZONE - 1):
            zone = grown(zone)
        self.zone = zone
        empty = zone & (stands.distance > 0)
        stands.density[empty] = raw_density(stands, FOG)
        stands.features[empty] = 0
        self.grids = {
            "stands density": GridTrainer(stands.density),
            "stands features": GridTrainer(stands.features),
            "movers density": GridTrainer(own.density),
            "movers features": GridTrainer(own.features),
        }
        modules = (stands.net, self.shading, self.corrections)
        self.net, self.light, self.places = (FlatAdam(module) for module in modules)
        self._look()

    def _look(self) -> None:
        """At what is empty by now."""
        self.stands.rebuild_occupancy()
        self.movers.canonical.rebuild_occupancy()
        self.movers.changed()
        for name, grid in self.grids.items():
            grid.visit(self.zone if name.startswith("stands") else self.region)

    def step(self, iteration: int) -> Step:
        """One iteration."""
        if iteration and iteration % OCCUPANCY_EVERY == 0:
            self._look()
        chosen = self.pictures[torch.randperm(len(self.pictures), generator=self.generator)[:PICTURES]]
        batch = self.left_out.without(
            draw_with_importance(
                self.rays, self.changing, self.options.together_rays, 1.0, chosen, self.generator
            )
        )
        parts = self._losses(batch, self.corrections.placed(), self.around.at(batch.frame, batch.pixel))
        batch = self.sweep.draw(round(SWEEP * self.options.together_rays), self.generator)
        batch = replace(batch, frame=torch.zeros_like(batch.frame))
        still = self._losses(batch, self.in_sweep, self.at_rest.around(batch.rays_o, batch.rays_d))
        (_weighted(parts) + SWEEP * _weighted(still) + self.shading.penalty()).backward()
        decay = self.guard.rate * self.options.learning_rate * 0.1 ** (iteration / self.iterations)
        for name, grid in self.grids.items():
            grid.update(decay * (LR_DENSITY if name.endswith("density") else LR_FEATURES))
        places = LR_PLACES * self.stands.voxel
        for optimiser, rate in ((self.net, LR_NET), (self.light, LR_SHADING), (self.places, places)):
            optimiser.step(decay * rate)
        return Step(self.options.together_rays, parts)

    def _losses(self, batch: RayBatch, placed: Placed, around: Around) -> dict[str, Tensor]:
        """Of rays before their surroundings; their gradient goes to the grids and to where parts are."""
        jitter = torch.rand(len(batch.rgb), generator=self.generator).to(batch.rgb)
        grads = Fields(*(grid.grad[0] for grid in self.grids.values()))
        rays = Rays(batch.rays_o, batch.rays_d, self.rest.near, jitter, batch.frame)
        seen = render_layered(self.stands, self.movers, placed, rays, grads, TRAINS)
        return {
            "mse": rendering_loss(around.compose(seen.rgb, seen.left), batch.rgb),
            "entropy": entropy_loss(seen.left),
            "per_point": per_point_loss(seen.weights, seen.colours, batch.rgb, seen.ray_id),
        }

    def state(self) -> State:
        """Everything that the next iteration depends on."""
        tensors = net_state(self.net) | grids_state(self.grids)
        return tensors | net_state(self.light, "light ") | net_state(self.places, "places "), {}

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`, at a point at which the next step looks."""
        take_up_grids(self.grids, saved.tensors)
        nets = {"": self.net, "light ": self.light, "places ": self.places}
        for name, net in nets.items():
            take_up_net(net, saved.tensors, name)

    def go_back(self) -> int:
        """To the beginning."""
        for mine, begun in zip((self.stands, self.movers.canonical), self.begun, strict=True):
            mine.density.copy_(begun.density)
            mine.features.copy_(begun.features)
            mine.distance = begun.distance
        self.stands.net.load_state_dict(self.begun[0].net.state_dict())
        with torch.no_grad():
            self.shading.grid.zero_()
            self.corrections.values.zero_()
        self._begin()
        return 0

    def finish(self) -> None:
        """No more training."""
        self.movers = self.corrections.applied(self.movers)
        self._look()
        for parameter in (*self.stands.net.parameters(), *self.shading.parameters()):
            parameter.requires_grad_(False)

    @torch.no_grad()
    def errors(self, movers: Movers | None) -> Errors:
        """Of pixels left out of training; None: if nothing moved."""
        still, asked = DynamicModel(self.rest), (self.rays, self.left_out, self.around)
        if movers is None:
            return errors_of(*asked, lambda some: still.box_at_rest(some.rays_o, some.rays_d))
        placed = movers.placed(self.rays.times)

        def seen(some: RayBatch) -> RayColours:
            rays = Rays.middle(some.rays_o, some.rays_d, self.rest.near, some.frame)
            return draw_layered(self.stands, movers, placed, rays, TRAINS)

        return errors_of(*asked, seen)


def _times(rays: RaySet, scene: Scene, offsets_s: Mapping[str, float]) -> tuple[Tensor, Tensor]:
    """Times of training pictures by moved clocks, and the numbers of those that are modelled then.

    All keep their numbers, and so the pixels that are left out: trainings with other clocks are compared by them.
    """
    time = {(f.camera_name, f.index): f.time for f in retimed(scene, offsets_s).dynamic}
    there = [(f.camera_name, f.index) in time for f in rays.frames]
    times = [time.get((f.camera_name, f.index), f.time) or 0.0 for f in rays.frames]
    return torch.tensor(times), torch.tensor(there).nonzero()[:, 0]


def _weighted(parts: dict[str, Tensor]) -> Tensor:
    return parts["mse"] + ENTROPY * parts["entropy"] + PER_POINT * parts["per_point"]


def _own(canonical: Canonical, net: torch.nn.Module) -> Canonical:
    """A copy that can be trained, with this MLP."""
    own = copy.copy(canonical)
    own.density, own.features = canonical.density.clone(), canonical.features.clone()
    own.net = net  # type: ignore[assignment]
    return own
