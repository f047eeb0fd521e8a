"""The scene at rest fine-tuned on the moving cameras' pictures too, once its motion is known.

The paper leaves the scene at rest as the sweep showed it, and names that as a limitation: shading changes as things
move, and what was hidden at rest keeps whatever colour it was left with. Here the motion stays and density, features
and MLP follow the pictures of all times at once, and the sweep's. The result is for pictures in motion; pictures of
the scene at rest are still made of what the sweep alone has taught.
"""

import copy
import math
import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from devrf.capture.progress import Progress, no_progress
from devrf.capture.scene import Scene
from devrf.reconstruct.canonical import Canonical
from devrf.reconstruct.grids import BETAS, EPS, GridTrainer
from devrf.reconstruct.held_back import HeldBack
from devrf.reconstruct.losses import entropy_loss, rendering_loss
from devrf.reconstruct.model import DynamicModel, live_distance, render_moved
from devrf.reconstruct.motion import MotionField
from devrf.reconstruct.moving_pixels import changing_pixels, draw_with_importance
from devrf.reconstruct.options import MotionOptions
from devrf.reconstruct.rays import RayBatch, RaySet
from devrf.reconstruct.render import plain_of, render_rest
from devrf.reconstruct.sizing import LEVEL_PAYS_DB, Decision
from devrf.reconstruct.surroundings import PixelSurroundings
from devrf.reconstruct.train_canonical import RestModel

NET_SHARE = 1 / 300  # the MLP's rate, of the grids'
ENTROPY = 1e-3  # weight
AT_ONCE = 1 << 14  # held-back rays
REACH = 2  # voxels of the scene at rest around where the moving scene may be


@dataclass(frozen=True)
class FineTuned:
    """What came of fine-tuning.

    Attributes:
        model: The scene at rest as it looks in motion; None where that gains nothing.
        gain_db: On pixels held back.
        seconds: It took.
        decision: Why there is no model.
    """

    model: RestModel | None
    gain_db: float
    seconds: float
    decision: Decision | None


def fine_tune(
    scene: Scene,
    rest: RestModel,
    motion: MotionField,
    options: MotionOptions,
    device: str = "cpu",
    progress: Progress = no_progress,
) -> FineTuned:
    """Train a copy of the scene at rest for `fine_tuning` iterations.

    Args:
        scene: Its moving cameras and its sweep are trained on.
        rest: The scene at rest; stays as it is.
        motion: Stays as it is.
        options: What can be chosen.
        device: cpu or cuda.
        progress: Told how far it is.
    """
    begun, iterations = time.perf_counter(), options.fine_tuning
    recipe = _Recipe(scene.in_box_frame(), rest, motion, options, device)
    before = recipe.held_error()
    for iteration in range(iterations):
        recipe.step(iteration)
        if iteration % 10 == 0:
            progress(iteration / iterations, f"fine-tuning, iteration {iteration} of {iterations}")
    model = recipe.model()
    after = recipe.held_error()
    gain = 10 * math.log10(before / after) if before > 0 and after > 0 else 0.0
    decision = None
    if options.adapt and gain < LEVEL_PAYS_DB:
        reason = f"it gained {gain:+.2f} dB on pixels held back, less than {LEVEL_PAYS_DB}"
        model, decision = None, Decision("fine-tuning", "none", f"{iterations} iterations", reason)
    return FineTuned(model, gain, time.perf_counter() - begun, decision)


class _Recipe:
    """The state of fine-tuning: the copy that is trained, its optimisers, and one iteration."""

    def __init__(
        self, scene: Scene, rest: RestModel, motion: MotionField, options: MotionOptions, device: str
    ) -> None:
        moving = tuple(f for f in scene.dynamic if f.split == "train" and f.time is not None)
        still = tuple(f for f in scene.static if f.split == "train")
        self.rays = RaySet(moving, scene.image_scale, scene.background, device)
        self.rays_at_rest = RaySet(still, scene.image_scale, scene.background, device)
        self.pictures = torch.arange(len(moving), device=self.rays.device)
        self.changing = changing_pixels(self.rays) if options.importance > 0 else None
        self.held_back = HeldBack(self.rays, self.changing)
        self.around = PixelSurroundings(DynamicModel(rest), self.rays)
        self.rest = replace(rest, canonical=_copied(rest.canonical))
        self.motion = replace(motion, backward=motion.backward.to(device))  # the forward field is not asked
        self.tau = motion.tau(self.rays.times)
        self.plain, self.options = plain_of(rest.background, device), options
        self.generator = torch.Generator().manual_seed(options.seed)
        canonical = self.rest.canonical
        reachable = canonical.reachable()
        self.density, self.features = GridTrainer(canonical.density), GridTrainer(canonical.features)
        for grid in (self.density, self.features):
            grid.visit(reachable)
        self.net = torch.optim.Adam(canonical.net.parameters(), 0.0, BETAS, EPS)
        self.live = self._live()

    def step(self, iteration: int) -> None:
        """One iteration, on rays of both kinds."""
        o, canonical = self.options, self.rest.canonical
        grads = (self.density.grad[0], self.features.grad[0])
        batch = self.held_back.without(
            draw_with_importance(
                self.rays, self.changing, o.rays, o.importance, self.pictures, self.generator
            )
        )
        rgb, left = self._seen(batch, self._jitter(1, batch)[0], grads)
        (rendering_loss(rgb, batch.rgb) + ENTROPY * entropy_loss(left)).backward()
        batch = self.rays_at_rest.draw(o.rays, self.generator)
        out = render_rest(
            canonical, self.rest.shell, self.plain, batch.rays_o, batch.rays_d, near=self.rest.near,
            far=self.rest.far, jitter=self._jitter(2, batch), grads=(*grads, None),
        )  # fmt: skip
        (rendering_loss(out.rgb, batch.rgb) + ENTROPY * entropy_loss(out.left)).backward()
        lr = o.fine_tuning_lr * 0.1 ** (iteration / o.fine_tuning)
        self.features.update(lr, flag=self.density.grad[0])
        self.density.update(lr)
        for group in self.net.param_groups:
            group["lr"] = NET_SHARE * lr
        self.net.step()
        self.net.zero_grad()

    def model(self) -> RestModel:
        """As it is now; what is empty is looked at again."""
        canonical = self.rest.canonical
        canonical.rebuild_occupancy(canonical.distance == 0)
        for parameter in canonical.net.parameters():
            parameter.requires_grad_(False)
        self.live = self._live()
        return replace(self.rest, shell=None, metrics={})

    @torch.no_grad()
    def held_error(self) -> float:
        """Mean squared error of rays of the moving cameras that are held back."""
        batch = self.held_back.rays_of(self.pictures)
        if batch is None:
            return 0.0
        errors = []
        for frame, pixel in zip(batch.frame.split(AT_ONCE), batch.pixel.split(AT_ONCE), strict=True):
            some = self.rays.at(frame, pixel)
            rgb, _ = self._seen(some, torch.full_like(some.time, 0.5), (None, None))
            errors.append(((rgb - some.rgb) ** 2).mean(1))
        return float(torch.cat(errors).mean())

    def _seen(
        self, batch: RayBatch, jitter: Tensor, grads: tuple[Tensor | None, Tensor | None]
    ) -> tuple[Tensor, Tensor]:
        """Colours of rays in motion, and the box's transmittance."""
        tau = self.tau[batch.frame]
        seen = render_moved(
            self.rest, self.motion, self.live, batch.rays_o, batch.rays_d, tau, jitter, rest_grads=grads
        )
        return self.around.at(batch.frame, batch.pixel).compose(seen.rgb, seen.left), seen.left

    def _jitter(self, rows: int, batch: RayBatch) -> Tensor:
        return torch.rand(rows, len(batch.rgb), generator=self.generator).to(batch.rgb)

    def _live(self) -> Tensor:
        taus = torch.arange(self.motion.keys, dtype=torch.float32, device=self.rays.device)
        return live_distance(self.rest, self.motion, taus, REACH)


def _copied(canonical: Canonical) -> Canonical:
    """A model of its own, whose MLP can be trained."""
    own = copy.copy(canonical)
    own.density, own.features = canonical.density.clone(), canonical.features.clone()
    own.net = copy.deepcopy(canonical.net)
    for parameter in own.net.parameters():
        parameter.requires_grad_(True)
    return own
