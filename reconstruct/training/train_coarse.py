"""A first, coarse model of everything in view, box and surroundings, that the real ones start from.

Plays the part of the published coarse stage: it finds where anything is, so that the fine stage spends its
samples there. One contracted grid of density and plain colours, rendered by the kernel of the surroundings,
which needs no MLP and stores no samples: ten times as many rays per second as the fine model through fog.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.adapt.background_reach import reach_of
from devrf.reconstruct.adapt.carving import carve, trained_lines
from devrf.reconstruct.fields.canonical import EMPTY, Canonical
from devrf.reconstruct.fields.contracted_background import CUBE, Shell
from devrf.reconstruct.fields.grids import GridTrainer, grown, upsample, vertices
from devrf.reconstruct.kernels.launch import copies_for
from devrf.reconstruct.kernels.march import RaySegments
from devrf.reconstruct.kernels.trilinear import trilinear
from devrf.reconstruct.options import CanonicalOptions
from devrf.reconstruct.rendering.rays import RayBatch, RaySet
from devrf.reconstruct.sampling.plates import draw_with_plates
from devrf.reconstruct.storage.checkpoint import NOWHERE, Checkpoint, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, take_up_grids
from devrf.reconstruct.training.losses import rendering_loss

SIZES = (0.4, 0.6, 0.8, 1.0)  # of `coarse_size`, each for a quarter of the iterations, where nothing is known
OCCUPANCY_EVERY = 20
LR = 0.5  # the coarse model has few steps to get from translucent to opaque
SEEN_BATCHES = 40  # of rays, to find what is visible
SEEN_WEIGHT = 5e-3
MOST_ALPHA = 0.5  # opacities are handed on no higher: what is opaque no longer learns


def train_coarse(
    scene: Scene,
    rays: RaySet,
    plates: RaySet | None,
    options: CanonicalOptions,
    device: str,
    generator: torch.Generator,
    log: TrainingLog,
    checkpoint: Checkpoint = NOWHERE,
) -> Shell:
    """Train the coarse model on the sweep and on plates; from the sweep's points where there are any."""
    lines, near = trained_lines(scene), scene.near
    aabb = torch.tensor(scene.aabb, dtype=torch.float32)
    sizes = [max(8, round(share * options.coarse_size)) for share in (SIZES if lines is None else (1.0,))]
    per_size = max(1, options.coarse_iterations // len(sizes))
    model = Shell.new(aabb, sizes[0], sizes[-1], near=near, reach=reach_of(scene), device=device, inside=True)
    if lines is not None:
        model.start_from(*carve(*lines, aabb, sizes[0], near, model.reach))
    trainer = GridTrainer(model.grid, copies_for(model.grid.device))
    begin, saved = 0, checkpoint.found(log)
    if saved is not None:
        begin, tensors, _ = saved
        model.grid = torch.empty_like(tensors["grid"], device=device)
        model.distance = tensors["distance"].to(device)
        trainer = GridTrainer(model.grid, copies_for(model.grid.device))
        take_up_grids({"grid": trainer}, tensors)
        trainer.visit(model.reachable())
        generator.set_state(tensors["generator"])

    def state() -> State:
        tensors = {"distance": model.distance, "generator": generator.get_state()}
        return tensors | grids_state({"grid": trainer}), {}

    for step in range(begin, per_size * len(sizes)):
        n, iteration = divmod(step, per_size)
        if n > 0 and iteration == 0:
            model.refine(sizes[n])
            trainer = GridTrainer(model.grid, copies_for(model.grid.device))
        if iteration % OCCUPANCY_EVERY == 0:
            trainer.visit(model.rebuild_occupancy())
        _loss(
            model,
            draw_with_plates(rays, plates, options.coarse_rays, generator),
            options,
            generator,
            trainer.grad,
        ).backward()
        trainer.update(LR * 0.1 ** ((n + iteration / per_size) / len(sizes)))
        checkpoint.keep(step + 1, per_size * len(sizes), log, state)
    return model


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


def _loss(
    model: Shell, batch: RayBatch, options: CanonicalOptions, generator: torch.Generator, grad: Tensor
) -> Float[Tensor, ""]:
    """Of rays that were drawn."""
    jitter = torch.rand(len(batch.rgb), generator=generator, device=generator.device).to(batch.rgb)
    begin = torch.full_like(jitter, model.near)
    segment = RaySegments(batch.rays_o, batch.rays_d, begin, begin, jitter)
    rgb, _, apart = model.render(segment, True, batch.rgb, grad)
    return rendering_loss(rgb, batch.rgb) + options.per_point * apart.mean()
