"""Stage 1: learn the scene at rest, and its surroundings, from the sweep (DeVRF 3.1, after DirectVoxGO).

The number of voxels doubles a few times early on; occupancy is rebuilt as density settles; the grids are trained
by masked Adam on the vertices that rays can touch, the MLP by Adam. Where in the box to look: `subject_box.py`.
"""

from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.capture.system.errors import ReconstructError
from devrf.capture.system.progress import part
from devrf.reconstruct.adapt.background_reach import contraction_of
from devrf.reconstruct.adapt.sizing import fewer_voxels
from devrf.reconstruct.fields.canonical import Canonical, new_canonical
from devrf.reconstruct.fields.canonical_model import RestModel
from devrf.reconstruct.fields.contracted_background import Shell, grey
from devrf.reconstruct.fields.ndc import Ndc
from devrf.reconstruct.fields.near_plane import points_of
from devrf.reconstruct.kernels.adam import add_total_variation, add_touched_variation
from devrf.reconstruct.kernels.march import march
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.rays import RayBatch, Rays, RaySet
from devrf.reconstruct.rendering.render import plain_of, render_rest, segments_in
from devrf.reconstruct.sampling.pictures import training
from devrf.reconstruct.sampling.plates import draw_with_plates, plates
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.training.canonical_state import CanonicalState, Hull
from devrf.reconstruct.training.loop import ON_CPU, Step, Training, TrainingRun, train
from devrf.reconstruct.training.losses import (
    VARIATION_CLAMP,
    entropy_loss,
    opacity_loss,
    per_point_loss,
    rendering_loss,
    variation_weight,
)
from devrf.reconstruct.training.subject_box import subject_box
from devrf.reconstruct.training.train_coarse import SEEN_BATCHES, Draw, hand_on, train_coarse, visible

LOG_EVERY = 25
ALPHA_INIT = 1e-2  # of a voxel that nothing is known about: thin enough to see through, thick enough to learn
LR_MLP = 1e-3  # initial; of the published program, as in every preset
FEWEST_DRAWN = 256  # rays of an iteration, however many samples they have
READING, COARSE = 0.05, 0.2  # shares of the progress bar for reading pictures and for finding the box
RAYS_AT_ONCE = 1 << 16
GOOD = "good "  # before the names of what a checkpoint holds of the last good point


def train_canonical(scene: Scene, options: CanonicalOptions, run: TrainingRun = ON_CPU) -> RestModel:
    """Train on the sweep's training pictures, and on what fixed training cameras show of what stands.

    Args:
        scene: Its pictures are trained on.
        options: What can be chosen.
        run: Its `watch` is shown the model (a `RestModel` without metrics).
    Raises:
        ReconstructError: No training pictures, nothing in the box, or the loss diverges with small steps, too.
    """
    scene = scene.in_box_frame()
    frames = training(scene.static)
    if not frames:
        text = "the sweep has no training pictures; the scene at rest cannot be learned"
        raise ReconstructError("pictures-none", text)
    log = TrainingLog(run.device, LOG_EVERY)
    reading = part(run.progress, 0.0, READING)
    rays = RaySet(frames, scene.image_scale, scene.background, run.device, reading)
    fixed, shares = plates(scene, run.device)
    generator = torch.Generator().manual_seed(options.seed)
    aabb, hull = subject_box(scene, rays, options, generator, log, run.part("", READING, COARSE))
    decisions: list[str] = []
    if options.adapt:
        ndc = None if scene.ndc is None else Ndc(*scene.ndc)
        options, decision = fewer_voxels(options, rays.cameras, aabb, ndc)
        decisions += [] if decision is None else [str(decision)]
    draw = partial(draw_with_plates, rays, fixed, generator=generator)
    recipe = _Recipe(scene, options, draw, (aabb, hull), generator, run.device)
    if hull is not None and options.box_search == "coarse":
        rays.keep_only(_hitting(rays, recipe.canonical, scene.near))
    of, shell = recipe.of, recipe.of.shell

    def begin() -> None:
        if shell is None:
            return
        run.progress(READING, "coarse model")
        coarse = train_coarse(scene, draw, options, generator, log, run.part("coarse", READING, 0.0))
        seen = visible(coarse, rays, SEEN_BATCHES, options.coarse_rays, generator)
        hand_on(coarse, seen, of.canonical, shell)
        of.restart()

    begun = READING + (COARSE if options.box_search == "coarse" and shell is None else 0.0)
    train(recipe, log, run.part("", begun, 1 - begun), begin)
    of.clear_untouched()  # what no ray has ever touched is empty
    of.find_reachable()
    for parameter in of.canonical.net.parameters():
        parameter.requires_grad_(False)
    run.progress(1.0, "scene at rest learned")
    metrics = log.summary() | {
        "pictures": len(frames),
        "plates": shares,
        "grid": list(recipe.canonical.shape),
        "aabb": recipe.canonical.aabb.tolist(),
        "occupied": float((recipe.canonical.distance == 0).float().mean()),
        "decisions": decisions,
        **recipe.guard.summary(),
    }
    return replace(recipe.shown(), metrics=metrics)


class _Recipe(Training):
    """What happens in and between iterations of stage 1."""

    name = "scene at rest"

    def __init__(
        self,
        scene: Scene,
        options: CanonicalOptions,
        draw: Draw,
        box: tuple[Tensor, Hull | None],
        generator: torch.Generator,
        device: str,
    ) -> None:
        super().__init__(options.iterations, generator)
        self.options, self.draw = options, draw
        self.scalings = {
            max(1, round(share * options.iterations)): n for n, share in enumerate(options.scale_at, 1)
        }
        self.near, self.far, self.background = scene.near, scene.far, scene.background
        self.plain = plain_of(scene.background, device)
        (aabb, hull), shell = box, None
        ndc = Ndc(*scene.ndc) if scene.ndc is not None else None
        resolution, shell_size = _sizes(options, 0)
        self.canonical = new_canonical(aabb, resolution, options, ALPHA_INIT, device, ndc)
        if self.plain is None:
            grid, points, contraction = grey(shell_size, device), points_of(scene), contraction_of(scene)
            final, near = options.shell_resolution, scene.near
            shell = Shell(aabb, grid, final, near, contraction, points=points).begun()
        self.of = CanonicalState(self.canonical, shell, hull)
        self.shell_variation = options.shell_variation * torch.tensor([0.1, 1, 1, 1], device=device)
        self.decay = 1.0
        self.good: dict[str, Tensor] = {}  # values at the last good point
        self.good_iteration = -1
        self.samples_per_ray = float(sum(self.canonical.shape[:2]))  # a guess to begin with

    @property
    def rays_now(self) -> int:
        """Rays for one iteration: as many as keep the number of samples near its aim."""
        fitting = round(self.options.samples / max(self.samples_per_ray, 1e-3))
        return max(FEWEST_DRAWN, min(self.options.rays, fitting))

    def settles(self, done: int) -> bool:
        """Whether what is trained is refined now, or handed on."""
        return done in self.scalings or super().settles(done)

    def step(self, iteration: int) -> Step:
        """One iteration, after what is to be done before it."""
        self._before(iteration)
        batch = self.draw(self.rays_now)
        rays = len(batch.rgb)
        jitter = torch.rand(2, rays, generator=self.generator, device=self.generator.device).to(batch.rgb)
        size = -(-rays // self.options.parts)
        parts = [slice(first, first + size) for first in range(0, rays, size)]
        found = [self._backward(batch.only(part), jitter[:, part], rays) for part in parts]
        self.samples_per_ray += 0.2 * (sum(samples for _, samples in found) / rays - self.samples_per_ray)
        self._update(rays)
        losses = {name: torch.stack([losses[name] for losses, _ in found]).sum() for name in found[0][0]}
        return Step(self.rays_now, losses, {"samples": self.samples_per_ray * self.rays_now})

    def _before(self, iteration: int) -> None:
        """Refine when it is time to; rebuild the occupancy every so often: these are points to go back to."""
        self.decay = self.guard.rate * 0.1 ** (iteration / self.options.iterations)
        if iteration == self.good_iteration:
            return  # gone back to
        if iteration in self.scalings:
            self.of.clear_untouched()
            self.good.clear()
            self.of.refine(*_sizes(self.options, self.scalings[iteration]))
            self.guard.begin()
        elif iteration and iteration % self.options.occupancy_every == 0:
            self.of.find_reachable()
            if not self.guard.sound():
                return
        elif iteration:
            return
        for name, values in self.of.values().items():
            self.good.setdefault(name, values.new_empty(values.shape)).copy_(values)
        self.good_iteration = iteration
        self.guard.good_point()

    def go_back(self) -> int:
        """To the last good point; returns its iteration."""
        for name, values in self.of.values().items():
            values.copy_(self.good[name])
        self.of.forget()
        return self.good_iteration

    def shown(self) -> RestModel:
        """The model so far."""
        return RestModel(self.canonical, self.of.shell, self.background, self.near, self.far, {})

    def _backward(self, batch: RayBatch, jitter: Tensor, every: int) -> tuple[dict[str, Tensor], int]:
        """Add the gradient of some of an iteration's rays; returns their share of the losses, and their samples."""
        rays = Rays(batch.rays_o, batch.rays_d, self.near, jitter)
        behind = self.plain if self.of.shell is None else self.of.shell
        out = render_rest(self.canonical, behind, rays, batch.rgb, self.of.grads())
        mse = rendering_loss(out.rgb, batch.rgb)
        entropy = entropy_loss(out.left)
        per_point = (
            per_point_loss(out.weights, out.colours, batch.rgb, out.ray_id) + out.shell_per_point.mean()
        )
        loss = mse + self.options.entropy * entropy + self.options.per_point * per_point
        if batch.opacity is not None:
            loss = loss + self.options.opacity * opacity_loss(out.left, batch.opacity)
        share = len(batch.rgb) / every
        (share * loss).backward()
        # Detached: what remembers how it was computed would keep the grids of a resolution that has been left.
        parts = {"mse": mse.detach(), "entropy": entropy.detach(), "per_point": per_point.detach()}
        return {name: share * value for name, value in parts.items()}, len(out.ray_id)

    def _update(self, rays: int) -> None:
        """A step of all optimisers."""
        of, options = self.of, self.options
        if options.variation:
            for grid in (of.density, of.features):
                weight = variation_weight(options.variation, grid.values.shape[:3], rays)
                add_total_variation(grid.values, grid.grad[0], weight, VARIATION_CLAMP)
        lr_grid, lr_mlp = (options.learning_rate * lr * self.decay for lr in (options.lr_grid, LR_MLP))
        of.features.update(lr_grid, flag=of.density.grad[0])  # touched alike
        of.density.update(lr_grid)
        if of.surround is not None and of.shell is not None:
            # Plain first, where pictures leave it open. To the end it takes detail away: 0.3 to 0.4 dB of a room with
            # shelves (docs/results.md, Static background).
            if of.shell.size < of.shell.final:
                around, weights = of.surround, self.shell_variation / rays
                add_touched_variation(around.values, around.grad, around.reachable, weights, VARIATION_CLAMP)
            of.surround.update(lr_grid)
        of.net.step(lr_mlp)

    def state(self) -> State:
        """Everything that the next iteration depends on."""
        return self.of.tensors() | {f"{GOOD}{name}": values for name, values in self.good.items()}, {
            "model": self.shown().numbers() | {"aabb": self.canonical.aabb.tolist()},  # to look at it
            "samples_per_ray": self.samples_per_ray,
            "good_iteration": self.good_iteration,
        }

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""
        _, tensors, numbers = saved
        self.of.take_up(tensors)
        self.samples_per_ray, self.good_iteration = numbers["samples_per_ray"], numbers["good_iteration"]
        good = {name.removeprefix(GOOD): x for name, x in tensors.items() if name.startswith(GOOD)}
        self.good = {name: x.to(self.canonical.density.device) for name, x in good.items()}


def _sizes(options: CanonicalOptions, level: int) -> tuple[float, int]:
    """Resolution of the box's grids at a level, and vertices along each axis of the surroundings."""
    share = 2.0 ** ((level - len(options.scale_at)) / 3)  # of the last level's, per axis
    return share * options.resolution, max(8, round(share * options.shell_resolution))


@torch.no_grad()
def _hitting(rays: RaySet, canonical: Canonical, near: float) -> Bool[Tensor, " pixels"]:
    """Of all pixels: whether their rays meet the space where the subject can be."""
    parts = []
    for batch in rays.in_order(RAYS_AT_ONCE):
        middle = torch.full_like(batch.rays_o[:, 0], 0.5)
        segments = segments_in(canonical.aabb, canonical.ndc, batch.rays_o, batch.rays_d, near, middle)
        offsets = march(segments, canonical.volume()).offsets
        parts.append(offsets[1:] > offsets[:-1])
    return torch.cat(parts)
