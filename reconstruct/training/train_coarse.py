"""A first, coarse model of everything in view, box and surroundings, that the real ones start from.

Plays the part of the published coarse stage: it finds where anything is, so that the fine stage spends its
samples there. One contracted grid of density and plain colours, rendered by the kernel of the surroundings,
which needs no MLP and stores no samples: ten times as many rays per second as the fine model through fog.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from jaxtyping import Bool
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.adapt.background_reach import contraction_of
from devrf.reconstruct.adapt.carving import carve, trained_lines
from devrf.reconstruct.fields.canonical import EMPTY, Canonical
from devrf.reconstruct.fields.contracted_background import CUBE, Shell, grey
from devrf.reconstruct.fields.grids import GridTrainer, grown, upsample, vertices
from devrf.reconstruct.kernels.launch import copies_for
from devrf.reconstruct.kernels.march import RaySegments
from devrf.reconstruct.kernels.trilinear import trilinear
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, take_up_grids
from devrf.reconstruct.training.loop import ON_CPU, Training, TrainingRun, train
from devrf.reconstruct.training.losses import rendering_loss

SIZES = (0.4, 0.6, 0.8, 1.0)  # of `coarse_size`, each for a quarter of the iterations, where nothing is known
OCCUPANCY_EVERY = 20
LR = 0.5  # the coarse model has few steps to get from translucent to opaque
SEEN_BATCHES = 40  # of rays, to find what is visible
SEEN_WEIGHT = 5e-3
MOST_ALPHA = 0.5  # opacities are handed on no higher: what is opaque no longer learns

Draw = Callable[[int], RayBatch]
"""Draws so many rays of the pictures that are trained on."""


def train_coarse(
    scene: Scene,
    draw: Draw,
    options: CanonicalOptions,
    generator: torch.Generator,
    log: TrainingLog,
    run: TrainingRun = ON_CPU,
) -> Shell:
    """Train the coarse model on the rays that are drawn; from the sweep's points where there are any."""
    training = _CoarseTraining(scene, draw, options, generator, run.device)
    train(training, log, run)
    return training.model


class _CoarseTraining(Training):
    """The coarse model and its steps."""

    name = "coarse model"

    def __init__(
        self, scene: Scene, draw: Draw, options: CanonicalOptions, generator: torch.Generator, device: str
    ) -> None:
        self.draw, self.options = draw, options
        lines, near = trained_lines(scene), scene.near
        aabb = torch.tensor(scene.aabb, dtype=torch.float32)
        shares = SIZES if lines is None else (1.0,)
        self.sizes = [max(8, round(share * options.coarse_size)) for share in shares]
        self.per_size = max(1, options.coarse_iterations // len(self.sizes))
        super().__init__(self.per_size * len(self.sizes), generator)
        grid, contraction = grey(self.sizes[0], device), contraction_of(scene)
        self.model = Shell(aabb, grid, self.sizes[-1], near, contraction, inside=True).begun()
        if lines is not None:
            self.model.start_from(*carve(*lines, aabb, self.sizes[0], near, contraction))
        self._new_trainer()

    def step(self, iteration: int) -> None:
        """One iteration; the model grows where it is time to."""
        n, within = divmod(iteration, self.per_size)
        if n > 0 and within == 0:
            self.model.refine(self.sizes[n])
            self._new_trainer()
        if within % OCCUPANCY_EVERY == 0:
            self.trainer.visit(self.model.rebuild_occupancy())
        batch = self.draw(self.options.coarse_rays)
        jitter = torch.rand(len(batch.rgb), generator=self.generator, device=self.generator.device)
        begin = torch.full_like(jitter.to(batch.rgb), self.model.near)
        segment = RaySegments(batch.rays_o, batch.rays_d, begin, begin, jitter.to(batch.rgb))
        rgb, _, apart = self.model.render(segment, True, batch.rgb, self.trainer.grad)
        (rendering_loss(rgb, batch.rgb) + self.options.per_point * apart.mean()).backward()
        self.trainer.update(LR * 0.1 ** ((n + within / self.per_size) / len(self.sizes)))

    def state(self) -> State:
        """Everything that the next iteration depends on."""
        return {"distance": self.model.distance} | grids_state({"grid": self.trainer}), {}

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""
        tensors, device = saved.tensors, self.model.grid.device
        self.model.grid = torch.empty_like(tensors["grid"], device=device)
        self.model.distance = tensors["distance"].to(device)
        self._new_trainer()
        take_up_grids({"grid": self.trainer}, tensors)
        self.trainer.visit(self.model.reachable())

    def _new_trainer(self) -> None:
        self.trainer = GridTrainer(self.model.grid, copies_for(self.model.grid.device))


def visible(
    model: Shell, rays: RaySet, batches: int, size: int, generator: torch.Generator
) -> Bool[Tensor, "N N N"]:
    """Vertices that some ray of the sweep sees, and their neighbours."""
    seen = torch.zeros(model.grid.shape[:3], device=model.grid.device)
    for _ in range(batches):
        batch = rays.draw(size, generator)
        half = torch.full((size,), 0.5, device=seen.device)
        begin = torch.full_like(half, model.near)
        with torch.no_grad():
            model.render(RaySegments(batch.rays_o, batch.rays_d, begin, begin, half), True, seen=seen)
    return grown(seen > SEEN_WEIGHT)


def hand_on(
    coarse: Shell,
    seen: Bool[Tensor, "N N N"],
    canonical: Canonical,
    shell: Shell,
) -> None:
    """Start the box's density and the surroundings from the coarse model; colours in the box are learned anew."""
    shell.grid = upsample(coarse.grid, (shell.size, shell.size, shell.size))
    shell.clear_inside()
    lo, hi = canonical.aabb
    x = vertices(canonical.aabb, canonical.shape).reshape(-1, 3)
    u = ((x - (lo + hi) / 2) * 2 / (hi - lo)).to(coarse.grid)
    raw = trilinear(coarse.grid[..., :1].contiguous(), u, CUBE)[:, 0]
    s = coarse.surroundings()
    # Opacity per length: a step of `s.step` in units of the box's half size has the exponent s.interval.
    half = float(((hi - lo) / 2).prod() ** (1 / 3))
    per_length = s.interval * F.softplus(raw + s.shift) / (s.step * half)
    most = -torch.log(torch.tensor(1 - MOST_ALPHA)) / canonical.interval
    optical = (per_length * canonical.base_voxel).clamp(1e-6, float(most))
    density = optical + torch.log(-torch.expm1(-optical)) - canonical.shift  # the softplus undone
    near = trilinear(seen.float()[..., None], u, CUBE)[:, 0]
    canonical.density[..., 0] = torch.where(near > 0, density, EMPTY).reshape(canonical.shape)
