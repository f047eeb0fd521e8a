"""Where a subject before a plain background is, as the published method finds it: by a coarse model (DirectVoxGO).

A small voxel grid of density and plain colours is trained on the sweep, its unknown space almost transparent. What
few pictures see and what lies just before a camera is kept empty; voxels that many rays cross learn faster. The
voxels that end up opaque give the tight box and the space in which the fine model looks.
"""

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from devrf.capture.scene import Scene
from devrf.reconstruct.fields.canonical import new_canonical
from devrf.reconstruct.fields.grids import GridTrainer, vertices
from devrf.reconstruct.options import STEP_AT_REST, CanonicalOptions
from devrf.reconstruct.rendering.rays import Rays, RaySet
from devrf.reconstruct.rendering.render import plain_of, render_rest
from devrf.reconstruct.storage.checkpoint import Saved, State
from devrf.reconstruct.storage.training_log import TrainingLog
from devrf.reconstruct.storage.training_state import grids_state, take_up_grids
from devrf.reconstruct.training.loop import Training, TrainingRun, train
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
    scene: Scene,
    rays: RaySet,
    options: CanonicalOptions,
    generator: torch.Generator,
    log: TrainingLog,
    run: TrainingRun,
) -> Bool[Tensor, "X Y Z"]:
    """Vertices of a coarse grid over the scene's box at which the subject is; the scene is in the box frame."""
    training = _SubjectTraining(scene, rays, options, generator)
    train(training, log, run)
    model = training.model
    per_voxel = 1 - torch.exp(-F.softplus(model.density[..., 0] + model.shift))
    return (per_voxel > SUBJECT_ALPHA).cpu()


class _SubjectTraining(Training):
    """The coarse model and its steps."""

    name = "box"

    def __init__(
        self, scene: Scene, rays: RaySet, options: CanonicalOptions, generator: torch.Generator
    ) -> None:
        aabb, device = torch.tensor(scene.aabb, dtype=torch.float32), str(rays.device)
        coarse = replace(
            options, resolution=options.coarse_size, channels=3, mlp_width=0, deferred=False,
            alpha_threshold=ALPHA_THRESHOLD, weight_threshold=ALPHA_THRESHOLD,
        )  # fmt: skip
        super().__init__(options.coarse_iterations, generator)
        self.rays, self.near = rays, scene.near
        self.plain = plain_of(scene.background, device)
        self.model = model = new_canonical(aabb, options.coarse_size, coarse, ALPHA_INIT, device)
        views = _views(rays, aabb, model.shape, scene.near)
        self.allowed = views >= min(FEWEST_VIEWS, len(rays))
        model.density[~self.allowed] = KEPT_EMPTY
        self.share = (views.float() / views.max().clamp(min=1))[..., None]
        self.grids = {"density": GridTrainer(model.density), "features": GridTrainer(model.features)}
        per_ray = max(1, int(1.2 * sum(model.shape) / 3 / STEP_AT_REST))
        self.most = max(256, min(options.coarse_rays, options.samples // per_ray))

    def step(self, iteration: int) -> None:
        """One iteration; each voxel learns at its own rate."""
        model, (density, features) = self.model, self.grids.values()
        if iteration % OCCUPANCY_EVERY == 0:
            density.visit(model.rebuild_occupancy(self.allowed))
            features.reachable = density.reachable
        batch = self.rays.draw(self.most, self.generator)
        jitter = torch.rand(2, self.most, generator=self.generator, device=self.generator.device)
        rays = Rays(batch.rays_o, batch.rays_d, self.near, jitter.to(batch.rgb))
        out = render_rest(model, self.plain, rays, grads=(density.grad[0], features.grad[0], None))
        loss = rendering_loss(out.rgb, batch.rgb) + ENTROPY * entropy_loss(out.left)
        loss = loss + PER_POINT * per_point_loss(out.weights, out.colours, batch.rgb, out.ray_id)
        loss.backward()
        lr = LR * LR_DECAY ** (iteration / DECAY_ITERATIONS)
        before = model.density.clone()
        features.update(lr)
        density.update(lr)
        model.density.sub_(before).mul_(self.share).add_(before)

    def state(self) -> State:
        """Everything that the next iteration depends on."""
        return {"distance": self.model.distance} | grids_state(self.grids), {}

    def take_up(self, saved: Saved) -> None:
        """Go on from a `state`."""
        self.model.distance = saved.tensors["distance"].to(self.model.density.device)
        take_up_grids(self.grids, saved.tensors)
        for grid in self.grids.values():
            grid.visit(self.model.reachable())


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
