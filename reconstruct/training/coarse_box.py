"""Where a subject before a plain background is, as the published method finds it: by a coarse model (DirectVoxGO).

A small voxel grid of density and plain colours is trained on the sweep, its unknown space almost transparent. What
few pictures see and what lies just before a camera is kept empty; voxels that many rays cross learn faster. The
voxels that end up opaque give the tight box and the space in which the fine model looks.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.system.progress import Progress
from devrf.reconstruct.fields.canonical import Canonical
from devrf.reconstruct.fields.grids import GridTrainer, vertices
from devrf.reconstruct.options import STEP_AT_REST, CanonicalOptions
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.rendering.render import render_rest
from devrf.reconstruct.storage.checkpoint import Checkpoint, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, take_up_grids
from devrf.reconstruct.training.losses import entropy_loss, per_point_loss, rendering_loss

ALPHA_INIT = 1e-6  # of a coarse voxel: space is seen through until something in it is learned
ALPHA_THRESHOLD = 1e-7
SUBJECT_ALPHA = 1e-3  # a voxel at least so opaque belongs to the subject
KEPT_EMPTY = -100.0
FEWEST_VIEWS = 3  # that have to see a voxel; two see floaters, which explain both
ENTROPY, PER_POINT = 0.01, 0.1
LR, LR_DECAY = 0.1, 0.1  # and by how much it falls over 20 000 iterations
DECAY_ITERATIONS = 20_000
OCCUPANCY_EVERY = 100


def find_subject(
    rays: RaySet,
    aabb: Float[Tensor, "2 3"],
    near: float,
    plain: Float[Tensor, " 3"],
    options: CanonicalOptions,
    generator: torch.Generator,
    progress: Progress,
    log: TrainingLog,
    checkpoint: Checkpoint,
) -> Bool[Tensor, "X Y Z"]:
    """Vertices of a coarse grid over `aabb` at which the subject is."""
    resolution, device = options.coarse_size, str(rays.device)
    model = Canonical.new(
        aabb, resolution, resolution, channels=3, mlp_width=0, stepsize=STEP_AT_REST, alpha_init=ALPHA_INIT,
        alpha_threshold=ALPHA_THRESHOLD, weight_threshold=ALPHA_THRESHOLD, device=device, seed=options.seed,
    )  # fmt: skip
    views = _views(rays, aabb, model.shape, near)
    allowed = views >= min(FEWEST_VIEWS, len(rays))
    model.density[~allowed] = KEPT_EMPTY
    share = (views.float() / views.max().clamp(min=1))[..., None]
    density, features = GridTrainer(model.density), GridTrainer(model.features)
    grids = {"density": density, "features": features}
    per_ray = max(1, int(1.2 * sum(model.shape) / 3 / STEP_AT_REST))
    most = max(256, min(options.coarse_rays, options.samples // per_ray))
    begin, saved = 0, checkpoint.found(log)
    if saved is not None:
        begin, tensors, _ = saved
        model.distance = tensors["distance"].to(device)
        take_up_grids(grids, tensors)
        for grid in grids.values():
            grid.visit(model.reachable())
        generator.set_state(tensors["generator"])

    def state() -> State:
        tensors = {"distance": model.distance, "generator": generator.get_state()}
        return tensors | grids_state(grids), {}

    for iteration in range(begin, options.coarse_iterations):
        if iteration % OCCUPANCY_EVERY == 0:
            density.visit(model.rebuild_occupancy(allowed))
            features.reachable = density.reachable
            progress(iteration / options.coarse_iterations, f"box: iteration {iteration}")
        batch = rays.draw(most, generator)
        jitter = torch.rand(2, most, generator=generator, device=generator.device).to(batch.rgb)
        out = render_rest(
            model, None, plain, batch.rays_o, batch.rays_d, near=near, jitter=jitter,
            grads=(density.grad[0], features.grad[0], None),
        )  # fmt: skip
        loss = rendering_loss(out.rgb, batch.rgb) + ENTROPY * entropy_loss(out.left)
        loss = loss + PER_POINT * per_point_loss(out.weights, out.colours, batch.rgb, out.ray_id)
        loss.backward()
        lr = LR * LR_DECAY ** (iteration / DECAY_ITERATIONS)
        before = model.density.clone()
        features.update(lr)
        density.update(lr)
        model.density.sub_(before).mul_(share).add_(before)  # each voxel at its own rate
        checkpoint.keep(iteration + 1, options.coarse_iterations, log, state)
    per_voxel = 1 - torch.exp(-F.softplus(model.density[..., 0] + model.shift))
    return (per_voxel > SUBJECT_ALPHA).cpu()


def _views(
    rays: RaySet, aabb: Float[Tensor, "2 3"], shape: tuple[int, int, int], near: float
) -> Int[Tensor, "X Y Z"]:
    """How many pictures see each vertex, lenses taken as pinholes; none of what is nearer than `near` to a camera."""
    points = vertices(aabb, shape).reshape(-1, 3).to(rays.device)
    count = torch.zeros(len(points), dtype=torch.int32, device=rays.device)
    blocked = torch.zeros(len(points), dtype=torch.bool, device=rays.device)
    for camera, R, centre in zip(rays.cameras, rays.rotations, rays.centres, strict=True):
        local = (points - centre) @ R
        pixel = local @ torch.from_numpy(camera.K).to(local).T
        u, v = pixel[:, 0] / pixel[:, 2], pixel[:, 1] / pixel[:, 2]
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        count += (local[:, 2] > 0) & inside
        blocked |= (local**2).sum(1) < near**2
    return torch.where(blocked, 0, count).reshape(shape)
