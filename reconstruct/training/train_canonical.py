"""Stage 1: learn the scene at rest, and its surroundings, from the sweep (DeVRF 3.1, after DirectVoxGO).

The number of voxels doubles a few times early on; occupancy is rebuilt as density settles; the grids are trained
by masked Adam on the vertices that rays can touch, the MLP by Adam. Where in the box to look: `subject_box.py`.
"""

from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.reconstruct.adapt.background_reach import reach_of
from devrf.reconstruct.adapt.sizing import fewer_voxels
from devrf.reconstruct.fields.canonical import EMPTY, Canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.contracted_background import Shell
from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.fields.grids import GridTrainer
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.fields.near_plane import points_of
from devrf.reconstruct.kernels.adam import add_total_variation, add_touched_variation
from devrf.reconstruct.kernels.launch import copies_for
from devrf.reconstruct.kernels.march import march
from devrf.reconstruct.options import STEP_AT_REST, CanonicalOptions
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.rendering.render import plain_of, render_rest, segments_in
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.sampling.plates import draw_with_plates, plates
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint, Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, net_state, take_up_grids, take_up_net
from devrf.reconstruct.storage.watch import Watch
from devrf.reconstruct.training.guard import Guard, diverged
from devrf.reconstruct.training.losses import (
    VARIATION_CLAMP,
    entropy_loss,
    opacity_loss,
    per_point_loss,
    rendering_loss,
    variation_weight,
)
from devrf.reconstruct.training.subject_box import subject_box
from devrf.reconstruct.training.train_coarse import SEEN_BATCHES, hand_on, train_coarse, visible

LOG_EVERY = 25
ALPHA_INIT = (
    1e-2  # of a voxel that nothing is known about: thin enough to see through, thick enough to learn from
)
LR_MLP = 1e-3  # initial; of the published program, as in every preset
FEWEST_DRAWN = 256  # rays of an iteration, however many samples they have
READING, COARSE = 0.05, 0.2  # shares of the progress bar for reading pictures and for finding the box
RAYS_AT_ONCE = 1 << 16
GOOD = "good "  # before the names of what a checkpoint holds of the last good point


def train_canonical(
    scene: Scene,
    options: CanonicalOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
    checkpoint: Checkpoint = NOWHERE,
    watch: Watch | None = None,
) -> RestModel:
    """Train on the sweep's training pictures, and on what fixed training cameras show of what stands.

    Args:
        scene: Its pictures are trained on.
        options: What can be chosen.
        device: cpu or cuda.
        progress: Told how far it is.
        checkpoint: Where to keep the state between two iterations, and to take it up from.
        watch: Shown the model (a `RestModel` without metrics) now and then.
    Raises:
        ReconstructError: No training pictures, nothing in the box, or the loss diverges with small steps, too.
    """
    scene = scene.in_box_frame()
    frames = training(scene.static)
    if not frames:
        text = "the sweep has no training pictures; the scene at rest cannot be learned"
        raise ReconstructError("pictures-none", text)
    log = TrainingLog(device, LOG_EVERY)
    rays = RaySet(frames, scene.image_scale, scene.background, device, part(progress, 0.0, READING))
    fixed, shares = plates(scene, device)
    generator = torch.Generator().manual_seed(options.seed)
    plain = plain_of(scene.background, device)
    aabb, hull = subject_box(
        scene, frames, rays, plain, options, generator,
        part(progress, READING, COARSE), log, checkpoint,
    )  # fmt: skip
    decision = None
    if options.adapt:
        ndc = None if scene.ndc is None else Ndc(*scene.ndc)
        options, decision = fewer_voxels(options, rays.cameras, aabb, ndc)
    recipe = _Recipe(scene, options, rays, plain, aabb, hull, device)
    if hull is not None and options.box_search == "coarse":
        rays.keep_only(recipe.hitting())
    saved = checkpoint.found(log)
    if saved is None and recipe.shell is not None:
        progress(READING, "coarse model")
        coarse = train_coarse(scene, rays, fixed, options, device, generator, log, checkpoint.part("coarse"))
        seen = visible(coarse, rays, SEEN_BATCHES, options.coarse_rays, generator)
        hand_on(coarse, seen, recipe.canonical, recipe.shell)
        recipe.restart()
    begun = READING + (COARSE if options.box_search == "coarse" and plain is not None else 0.0)
    iteration = 0 if saved is None else recipe.take_up(saved, generator)
    while iteration < options.iterations:
        recipe.before(iteration)
        parts = recipe.step(draw_with_plates(rays, fixed, recipe.rays_now, generator), generator)
        samples = recipe.samples_per_ray * recipe.rays_now
        ran_away = recipe.guard.ran_away(log, recipe.rays_now, parts, samples=samples)
        if ran_away or (recipe.no_way_back(iteration + 1) and not recipe.guard.sound()):
            iteration = recipe.go_back(log, iteration)
            continue
        if iteration % 10 == 0:
            done = begun + (1 - begun) * iteration / options.iterations
            last = f", PSNR {log.rows[-1]['psnr']:.1f} dB" if log.rows else ""
            progress(done, f"iteration {iteration} of {options.iterations}{last}")
            if watch is not None:
                watch(log, lambda: recipe.model({}))
        iteration += 1
        checkpoint.keep(iteration, options.iterations, log, lambda: recipe.state(generator))
    recipe.finish()
    log.close_row()
    progress(1.0, "scene at rest learned")
    metrics = log.summary() | {
        "pictures": len(frames),
        "plates": shares,
        "grid": list(recipe.canonical.shape),
        "aabb": recipe.canonical.aabb.tolist(),
        "occupied": float((recipe.canonical.distance == 0).float().mean()),
        "decisions": [str(decision)] if decision is not None else [],
        **recipe.guard.summary(),
    }
    return recipe.model(metrics)


class _Recipe:
    """The state of stage 1: models, optimisers, and what happens between and in iterations."""

    def __init__(
        self,
        scene: Scene,
        options: CanonicalOptions,
        rays: RaySet,
        plain: Tensor | None,
        aabb: Tensor,
        hull: tuple[Tensor, Tensor] | None,
        device: str,
    ) -> None:
        self.options, self.rays, self.plain, self.hull = options, rays, plain, hull
        self.scalings = {
            max(1, round(share * options.iterations)): n for n, share in enumerate(options.scale_at, 1)
        }
        self.near, self.far, self.background = scene.near, scene.far, scene.background
        self.canonical = Canonical.new(
            aabb,
            self._share(0) * options.resolution,
            options.resolution,
            channels=options.channels,
            mlp_width=options.mlp_width,
            stepsize=STEP_AT_REST,
            alpha_init=ALPHA_INIT,
            alpha_threshold=options.alpha_threshold,
            weight_threshold=options.weight_threshold,
            device=device,
            seed=options.seed,
            deferred=options.deferred,
            planes=options.planes if scene.ndc is not None else None,
            ndc=Ndc(*scene.ndc) if scene.ndc is not None else None,
        )
        self.shell: Shell | None = None
        if plain is None:
            self.shell = Shell.new(
                aabb,
                self._shell_size(0),
                options.shell_resolution,
                near=scene.near,
                reach=reach_of(scene),
                device=device,
                points=points_of(scene),
            )
        self.shell_variation = options.shell_variation * torch.tensor([0.1, 1, 1, 1], device=device)
        self.net_optimiser = FlatAdam(self.canonical.net)
        self.decay = 1.0
        self.guard = Guard()
        self.good: dict[str, Tensor] = {}  # values at the last good point
        self.good_iteration = -1
        self.samples_per_ray = float(
            self.canonical.shape[0] + self.canonical.shape[1]
        )  # a guess to begin with
        self.restart()

    @property
    def rays_now(self) -> int:
        """Rays for one iteration: as many as keep the number of samples near its aim."""
        fitting = round(self.options.samples / max(self.samples_per_ray, 1e-3))
        return max(FEWEST_DRAWN, min(self.options.rays, fitting))

    def no_way_back(self, iteration: int) -> bool:
        """Whether what is trained is refined now, or handed on."""
        return iteration in self.scalings or iteration == self.options.iterations

    def before(self, iteration: int) -> None:
        """Refine when it is time to; rebuild the occupancy every so often: these are points to go back to."""
        self.decay = self.guard.rate * 0.1 ** (iteration / self.options.iterations)
        if iteration == self.good_iteration:
            return  # gone back to
        if iteration in self.scalings:
            self._clear_untouched()
            self.good.clear()
            del self.density, self.features, self.surround  # their memory is what the next resolution needs
            level = self.scalings[iteration]
            self.canonical.refine(self._share(level) * self.options.resolution)
            if self.shell is not None:
                self.shell.refine(self._shell_size(level))
            self.restart()
            self.guard.begin()
        elif iteration and iteration % self.options.occupancy_every == 0:
            self._find_reachable()
            if not self.guard.sound():
                return
        elif iteration:
            return
        for name, values in self._values().items():
            self.good.setdefault(name, values.new_empty(values.shape)).copy_(values)
        self.good_iteration = iteration
        self.guard.good_point()

    def _values(self) -> dict[str, Tensor]:
        """All that is trained, by name."""
        values = {name: grid.values for name, grid in self._grids().items()}
        return values | {f"net.{name}": x for name, x in self.canonical.net.state_dict().items()}

    def go_back(self, log: TrainingLog, iteration: int) -> int:
        """To the last good point, with smaller steps; returns its iteration.

        Raises:
            ReconstructError: Steps are small enough.
        """
        if not self.guard.go_back(log, f"scene at rest, iteration {iteration}"):
            raise diverged(f"the loss of the scene at rest ran away at iteration {iteration}")
        for name, values in self._values().items():
            values.copy_(self.good[name])
        for grid in self._grids().values():
            grid.forget()
        self.net_optimiser.forget()
        self._find_reachable()
        return self.good_iteration

    def model(self, metrics: dict[str, Any]) -> RestModel:
        """As it is now."""
        return RestModel(self.canonical, self.shell, self.background, self.near, self.far, metrics)

    def step(self, batch: RayBatch, generator: torch.Generator) -> dict[str, Tensor]:
        """One iteration; returns the unweighted losses."""
        rays = len(batch.rgb)
        jitter = torch.rand(2, rays, generator=generator, device=generator.device).to(batch.rgb)
        size = -(-rays // self.options.parts)
        parts = [slice(first, first + size) for first in range(0, rays, size)]
        found = [self._backward(batch.only(part), jitter[:, part], rays) for part in parts]
        self.samples_per_ray += 0.2 * (sum(samples for _, samples in found) / rays - self.samples_per_ray)
        self._update(rays)
        return {name: torch.stack([losses[name] for losses, _ in found]).sum() for name in found[0][0]}

    def _backward(self, batch: RayBatch, jitter: Tensor, rays: int) -> tuple[dict[str, Tensor], int]:
        """Add the gradient of some of an iteration's rays; returns their share of the losses, and their samples."""
        around = None if self.surround is None else self.surround.grad
        grads = (self.density.grad[0], self.features.grad[0], around)
        out = render_rest(
            self.canonical, self.shell, self.plain, batch.rays_o, batch.rays_d,
            near=self.near, jitter=jitter, target=batch.rgb, grads=grads,
        )  # fmt: skip
        mse = rendering_loss(out.rgb, batch.rgb)
        entropy = entropy_loss(out.left)
        per_point = (
            per_point_loss(out.weights, out.colours, batch.rgb, out.ray_id) + out.shell_per_point.mean()
        )
        loss = mse + self.options.entropy * entropy + self.options.per_point * per_point
        if batch.opacity is not None:
            loss = loss + self.options.opacity * opacity_loss(out.left, batch.opacity)
        share = len(batch.rgb) / rays
        (share * loss).backward()
        # Detached: what remembers how it was computed would keep the grids of a resolution that has been left.
        parts = {"mse": mse.detach(), "entropy": entropy.detach(), "per_point": per_point.detach()}
        return {name: share * value for name, value in parts.items()}, len(out.ray_id)

    def _update(self, rays: int) -> None:
        """A step of all optimisers."""
        if self.options.variation:
            for grid in (self.density, self.features):
                weight = variation_weight(self.options.variation, grid.values.shape[:3], rays)
                add_total_variation(grid.values, grid.grad[0], weight, VARIATION_CLAMP)
        lr_grid, lr_mlp = (
            self.options.learning_rate * lr * self.decay for lr in (self.options.lr_grid, LR_MLP)
        )
        self.features.update(lr_grid, flag=self.density.grad[0])  # touched alike
        self.density.update(lr_grid)
        if self.surround is not None and self.shell is not None:
            # Plain first, where pictures leave it open. To the end it takes detail away: 0.3 to 0.4 dB of a room with
            # shelves (docs/results.md, Static background).
            if self.shell.size < self.shell.final:
                around, weights = self.surround, self.shell_variation / rays
                add_touched_variation(around.values, around.grad, around.reachable, weights, VARIATION_CLAMP)
            self.surround.update(lr_grid)
        self.net_optimiser.step(lr_mlp)

    def state(self, generator: torch.Generator) -> State:
        """Everything that the next iteration depends on."""
        tensors = {"distance": self.canonical.distance, "generator": generator.get_state()}
        tensors |= net_state(self.net_optimiser) | grids_state(self._grids())
        if self.shell is not None:
            tensors["surround distance"] = self.shell.distance
        tensors |= {f"{GOOD}{name}": values for name, values in self.good.items()}
        return tensors, {
            "model": self.model({}).numbers() | {"aabb": self.canonical.aabb.tolist()},  # to look at it
            "samples_per_ray": self.samples_per_ray,
            "good_iteration": self.good_iteration,
            "guard": self.guard.state(),
        }

    def take_up(self, saved: Saved, generator: torch.Generator) -> int:
        """Go on from a `state`; returns the number of iterations behind it."""
        done, tensors, numbers = saved
        device, target = self.canonical.density.device, self.canonical
        target.density, target.features = (
            torch.empty_like(tensors[name], device=device) for name in ("density", "features")
        )
        target.distance = tensors["distance"].to(device)
        if self.shell is not None:
            self.shell.grid = torch.empty_like(tensors["surround"], device=device)
            self.shell.distance = tensors["surround distance"].to(device)
        self.samples_per_ray, self.good_iteration = numbers["samples_per_ray"], numbers["good_iteration"]
        self.guard.take_up(numbers["guard"])
        good = {name.removeprefix(GOOD): x for name, x in tensors.items() if name.startswith(GOOD)}
        self.good = {name: x.to(device) for name, x in good.items()}
        take_up_net(self.net_optimiser, tensors)
        self._new_trainers()
        take_up_grids(self._grids(), tensors)
        self._visit(self.canonical.reachable(), None if self.shell is None else self.shell.reachable())
        generator.set_state(tensors["generator"])
        return done

    @torch.no_grad()
    def hitting(self) -> Bool[Tensor, " pixels"]:
        """Of all pixels: whether their rays meet the space where the subject can be."""
        parts = []
        for batch in self.rays.in_order(RAYS_AT_ONCE):
            middle = torch.full_like(batch.rays_o[:, 0], 0.5)
            segments = segments_in(
                self.canonical.aabb, self.canonical.ndc, batch.rays_o, batch.rays_d, self.near, middle
            )
            offsets = march(segments, self.canonical.volume()).offsets
            parts.append(offsets[1:] > offsets[:-1])
        return torch.cat(parts)

    def finish(self) -> None:
        """Empty what no ray has ever touched, and look at the occupancy for the last time."""
        self._clear_untouched()
        self._find_reachable()
        for parameter in self.canonical.net.parameters():
            parameter.requires_grad_(False)

    def _share(self, level: int) -> float:
        """Size of level `level`'s grid relative to the last, per axis."""
        return 2.0 ** ((level - len(self.options.scale_at)) / 3)

    def _shell_size(self, level: int) -> int:
        return max(8, round(self._share(level) * self.options.shell_resolution))

    def restart(self) -> None:
        """Fresh moments for grids that are new or have been replaced."""
        self._new_trainers()
        self._find_reachable()

    def _new_trainers(self) -> None:
        self.density, self.features = (
            GridTrainer(self.canonical.density),
            GridTrainer(self.canonical.features),
        )
        self.surround = None
        if self.shell is not None:
            self.surround = GridTrainer(self.shell.grid, copies_for(self.shell.grid.device))

    def _grids(self) -> dict[str, GridTrainer]:
        grids = {"density": self.density, "features": self.features}
        return grids if self.surround is None else grids | {"surround": self.surround}

    def _find_reachable(self) -> None:
        around = None if self.shell is None else self.shell.rebuild_occupancy()
        self._visit(self.canonical.rebuild_occupancy(self._within()), around)

    def _visit(self, reachable: Bool[Tensor, "X Y Z"], around: Bool[Tensor, "N N N"] | None) -> None:
        self.density.visit(reachable)
        self.features.reachable = self.density.reachable
        if self.surround is not None and around is not None:
            self.surround.visit(around)

    def _within(self) -> Tensor | None:
        """Vertices of the present grid that lie in the hull."""
        if self.hull is None:
            return None
        kept, box = self.hull
        shape, target = torch.tensor(kept.shape), self.canonical
        index = []
        for axis in range(3):
            x = torch.linspace(float(target.aabb[0, axis]), float(target.aabb[1, axis]), target.shape[axis])
            at = (x - box[0, axis]) / (box[1, axis] - box[0, axis]) * (shape[axis] - 1)
            index.append(at.round().long().clamp(0, int(shape[axis]) - 1))
        return kept[index[0]][:, index[1]][:, :, index[2]].to(target.density.device)

    def _clear_untouched(self) -> None:
        """What no ray has passed in this level is taken to be empty, not translucent."""
        self.canonical.density[..., 0][~self.density.touched()] = EMPTY
        if self.shell is not None and self.surround is not None:
            touched = (self.surround.moment2[..., 0] > 0)[..., None]
            self.shell.grid[..., :1] = torch.where(touched, self.shell.grid[..., :1], EMPTY)
