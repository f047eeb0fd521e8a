"""Deformable 3D Gaussians (Yang et al., CVPR 2024): Gaussians at rest, and a network that moves, turns and sizes them.

Published: a network of 8 layers of 256 with ten frequencies of places and six of times (for synthetic scenes),
Gaussians learned alone at first (`ALONE`), losses of Kerbl et al. (2023): L1 and D-SSIM by 0.8 and 0.2. The number of
Gaussians stays: those that fade are taken to where pictures pull most (after Kheradmand et al., 2024), in place of
growing and pruning. Lens distortion is not rendered.
"""

from dataclasses import dataclass

import kornia
import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from devrf.capture.camera import Camera
from devrf.lab.methods.clock import TrainingClock
from devrf.lab.methods.method_table import Regime
from devrf.lab.methods.networks import FREQUENCIES, Encoding, Mlp
from devrf.lab.methods.pictures import Space, TaskPictures
from devrf.lab.methods.protocol import MethodTask, TimeBudget
from devrf.reconstruct.kernels.splat import splat
from devrf.reconstruct.rendering.rays import RaySet
from devrf.reconstruct.splats.gaussians import Gaussians, flattened, product, tiles_of

NUMBERS = {"small": 4000, "full": 100_000}
NETWORKS = {"small": (4, 64), "full": (8, 256)}  # depth and width
RATES = {"places": 2e-3, "quats": 1e-3, "log_scales": 5e-3, "logits": 5e-2, "colours": 1e-2}
WARP_RATES, LAST = {"small": 2e-3, "full": 8e-4}, 0.01
ALONE = 0.1  # of the budget, in which nothing is moved
SSIM_SHARE, SSIM_SIDE = 0.2, 11
FADED, EVERY = 0.02, 100  # opacity of those that are taken elsewhere, and steps from time to time
MOST, UNTIL = 0.05, 0.5  # share of all that is taken at once; of the budget, after which all stay
SCALE = 2.0  # of a Gaussian at first, in distances to its nearest neighbour if all filled the box evenly
OUTSIDE = 0.3  # share of Gaussians in the surroundings, where they are seen
FARTHEST = 8.0  # box units


class DeformableGaussians(nn.Module):
    """Gaussians at rest and what moves them."""

    def __init__(self, task: MethodTask, space: Space) -> None:
        super().__init__()
        places, colours = _first(task, space)
        volume = float((space.high - space.low).prod()) * space.filled
        scale = float(np.log(SCALE * (volume / len(places)) ** (1 / 3) / 2))
        self.leaves = nn.ParameterDict(
            {
                "places": places,
                "quats": torch.tensor([1.0, 0, 0, 0]).repeat(len(places), 1),
                "log_scales": torch.full((len(places), 3), scale),
                "logits": torch.full((len(places),), -2.0),
                "colours": colours,
            }
        )
        depth, width = NETWORKS[task.size]
        self.place, self.time = Encoding(3, FREQUENCIES[task.size]), Encoding(1, 6)
        self.warp = Mlp(self.place.size + self.time.size, 10, depth, width, small=1e-4)
        self.space = space

    def at(self, time: float | None) -> Gaussians:
        """The Gaussians at a time; None: at rest."""
        now = Gaussians(**dict(self.leaves.items()))
        if time is None:
            return now
        x = self.place(self.space.contracted(now.places.detach()))
        t = self.time(x.new_full((1, 1), 2 * time - 1)).expand(len(x), -1)
        out = self.warp(torch.cat([x, t], 1))
        turn = out[:, 3:7] + out.new_tensor([1.0, 0, 0, 0])
        return Gaussians(
            now.places + out[:, :3],
            product(turn, now.quats),
            now.log_scales + out[:, 7:],
            now.logits,
            now.colours,
        )


@dataclass
class TrainedGaussians:
    """Gaussians that render."""

    moved: DeformableGaussians

    @property
    def megabytes(self) -> float:
        """Of all parameters."""
        return 4 * sum(p.numel() for p in self.moved.parameters()) / 1e6

    @torch.no_grad()
    def render(
        self, camera: Camera, time: float | None
    ) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
        """Colours and depths of a camera in the box frame."""
        now, behind = self.moved.at(time), self.moved.space.behind
        rgb, flat, depth, tiles = _drawn(now, camera, now.places.new_zeros(3) if behind is None else behind)
        deep = torch.cat([flat[:, :6], depth[:, None].expand(-1, 3)], 1)
        far = splat(deep, *tiles, (camera.width, camera.height), now.places.new_zeros(3))
        return rgb.clamp(0, 1).cpu().numpy(), far[..., 0].cpu().numpy()


class GaussianMethod:
    """`gaussians`."""

    regimes: tuple[Regime, ...] = ("joint", "two-stage", "dynamic")

    def why_not(self, task: MethodTask) -> str | None:
        """It can do every task."""
        return None

    def train(self, task: MethodTask, budget: TimeBudget) -> TrainedGaussians:
        """Train it.

        Raises:
            Diverged: The loss is no number.
        """
        torch.manual_seed(task.seed)
        pictures, space = TaskPictures(task), Space.of(task)
        moved = DeformableGaussians(task, space).to(task.device)
        model, clock = TrainedGaussians(moved), TrainingClock(budget, task.device)
        groups = [{"params": [moved.leaves[name]], "lr": rate} for name, rate in RATES.items()]
        adam = torch.optim.Adam(
            [*groups, {"params": moved.warp.parameters(), "lr": WARP_RATES[task.size]}], eps=1e-15
        )
        first = [group["lr"] for group in adam.param_groups]
        generator = torch.Generator().manual_seed(task.seed)
        pull = torch.zeros(len(moved.leaves["places"]), device=task.device)
        while (share := clock.share) < 1:
            still, moves = _what(task, share, generator, pictures)
            for group, rate in zip(adam.param_groups, first, strict=True):
                group["lr"] = rate * LAST**share
            frozen = task.regime == "two-stage" and share >= 0.5
            for leaf in moved.leaves.values():
                leaf.requires_grad_(not frozen)
            adam.zero_grad()
            rays: RaySet = pictures.static if still and pictures.static is not None else pictures.moving
            n = int(torch.randint(len(rays), (1,), generator=generator))
            time = float(rays.times[n]) if moves else None
            true = torch.from_numpy(rays.picture(n).astype(np.float32) / 255).to(task.device)
            behind = true.new_zeros(3) if space.behind is None else space.behind
            rgb, flat, _, _ = _drawn(moved.at(time), rays.cameras[n], behind)
            if flat.requires_grad:
                flat.retain_grad()
            loss = (1 - SSIM_SHARE) * (rgb - true).abs().mean() + SSIM_SHARE * _dssim(rgb, true)
            loss.backward()
            adam.step()
            if flat.grad is not None and not frozen:
                pull += flat.grad[:, :2].norm(dim=1)
                if clock.steps % EVERY == EVERY - 1 and share < UNTIL:
                    _taken_elsewhere(moved, adam, pull)
                    pull.zero_()
            clock.step(model, true.shape[0] * true.shape[1], loss)
        return model


def _what(
    task: MethodTask, share: float, generator: torch.Generator, pictures: TaskPictures
) -> tuple[bool, bool]:
    """Whether the next picture is one of the sweep, and whether Gaussians are moved in it."""
    if task.regime == "dynamic" or pictures.static is None:
        return False, share >= ALONE
    if task.regime == "two-stage":
        return share < 0.5, share >= 0.5
    still = share < ALONE or float(torch.rand(1, generator=generator)) < 0.5
    return still, not still


def _first(task: MethodTask, space: Space) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
    """Places and colours at first: points of structure from motion, else anywhere in the box."""
    rng = np.random.default_rng(task.seed)
    number, points = NUMBERS[task.size], task.boxed.points
    low, high = space.low.cpu().numpy(), space.high.cpu().numpy()
    places = rng.uniform(low, high, (number, 3))
    if space.hull is not None:  # where something can be
        kept = space.hull.nonzero().cpu().numpy()
        cells = kept[rng.integers(len(kept), size=number)] + rng.uniform(-0.5, 0.5, (number, 3))
        places = low + cells / (np.array(space.hull.shape) - 1) * (high - low)
    if space.surrounded:
        out = round(OUTSIDE * number)
        ways = rng.normal(size=(out, 3))
        places[:out] = (
            ways / np.linalg.norm(ways, axis=1, keepdims=True) * rng.uniform(1.5, FARTHEST, (out, 1))
        )
    if points is not None and len(points.xyz):
        known = points.xyz[rng.permutation(len(points.xyz))[: number // 2]]
        places[-len(known) :] = known
    colours = torch.from_numpy(rng.uniform(0.3, 0.7, places.shape)).float()
    return torch.from_numpy(places).float(), colours


def _drawn(
    gaussians: Gaussians, camera: Camera, behind: Float[Tensor, " 3"]
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """The picture, the flat Gaussians and their depths, and the lists of the tiles."""
    size = camera.width, camera.height
    flat, depth, spread = flattened(gaussians, camera)
    tiles = tiles_of(flat.detach(), depth.detach(), spread.detach(), size)
    return splat(flat, *tiles, size, behind), flat, depth, tiles


def _dssim(a: Float[Tensor, "h w 3"], b: Float[Tensor, "h w 3"]) -> Tensor:
    """Structural dissimilarity, 0 for equal pictures."""
    return kornia.losses.ssim_loss(a.movedim(-1, 0)[None], b.movedim(-1, 0)[None], SSIM_SIDE)


@torch.no_grad()
def _taken_elsewhere(moved: DeformableGaussians, adam: torch.optim.Adam, pull: Float[Tensor, " N"]) -> None:
    """Give faded Gaussians half of those that pictures pull most."""
    leaves = moved.leaves
    faded = (torch.sigmoid(leaves["logits"]) < FADED).nonzero()[:, 0]
    pull = pull.index_fill(0, faded, -1)
    wide = pull.argsort(descending=True)[: min(len(faded), len(pull) - len(faded), round(MOST * len(pull)))]
    faded = faded[: len(wide)]
    if not len(wide):
        return
    axes = Gaussians(**dict(leaves.items())).axes[wide]
    which = leaves["log_scales"][wide].argmax(1)
    along = 0.6 * axes[torch.arange(len(wide), device=axes.device), :, which]
    opacity = torch.sigmoid(leaves["logits"][wide])
    leaves["logits"][wide] = torch.logit(1 - torch.sqrt(1 - opacity.clamp(max=0.99)))
    leaves["log_scales"][wide, which] += float(np.log(0.6))
    for leaf in leaves.values():
        leaf[faded] = leaf[wide]
    leaves["places"][wide] += along
    leaves["places"][faded] -= along
    for leaf in leaves.values():
        for moment in ("exp_avg", "exp_avg_sq"):
            if moment in adam.state[leaf]:
                adam.state[leaf][moment][torch.cat([wide, faded])] = 0


METHOD = GaussianMethod()
