"""Fit Gaussians to pictures of the model by gradient descent (Kerbl et al. 2023, Section 5).

Each picture is of one time, to which the Gaussians are moved; what is learned is one set of them, at rest. Their number
stays. After a round those that no picture shows are taken to where the pictures pull most: a Gaussian there is
cut in two along its longest axis (their densification, with a fixed budget).

No Gaussian becomes finer than a part of the pixels it was fitted to: in a picture `BLUR` hides what is finer, but in a
larger one, or from nearer, it falls apart into dots (Yu et al., Mip-Splatting, 2024, Section 4.1).
"""

from collections.abc import Sequence
from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.camera import Camera
from devrf.capture.system.progress import Progress, no_progress
from devrf.reconstruct.kernels.splat import splat
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.splats.gaussians import Gaussians, flattened, pixel_sizes, tiles_of
from devrf.reconstruct.splats.looks import ModelView
from devrf.reconstruct.splats.moving import Nodes, moved

SEED = 0  # of the order of pictures
# places in standard deviations; thrice the published rates and more, for a hundredth of the published steps
RATES = {"places": 0.2, "quats": 1e-2, "log_scales": 5e-2, "logits": 1e-1, "colours": 3e-2}
LAST = 0.1  # rates at the end
BETAS, EPS = (0.9, 0.99), 1e-15
FINEST_PX = 0.4  # standard deviation, in pixels of the picture that shows a Gaussian largest
UNSEEN_PX = 0.5  # pixels that a Gaussian adds to in its best picture: with fewer it is taken elsewhere
MOST_TAKEN = 0.25  # of all, after a round
CUT = 0.6  # of the longest standard deviation: how far the halves lie from the middle, and how long they are


def fit(
    model: DynamicModel,
    start: tuple[Gaussians, Nodes | None],
    looks: Sequence[ModelView],
    behind: Float[Tensor, " 3"],
    rounds: int,
    progress: Progress = no_progress,
) -> Gaussians:
    """The Gaussians after so many rounds through all pictures.

    Args:
        model: What moves them.
        start: Gaussians at rest, and their nodes where parts are rigid; these learn the part of those that are taken
            elsewhere.
        looks: Pictures of the model.
        behind: Colour behind everything.
        rounds: Through all pictures, each in an order of its own.
        progress: To be called with (fraction done, short text).
    """
    gaussians, nodes = start
    learned = _Learned(gaussians, [look.camera for look in looks])
    if nodes is not None:
        learned.nodes = nodes.then(model, [look.time for look in looks])
    adam = torch.optim.Adam(
        [{"params": [leaf], "lr": RATES[name]} for name, leaf in learned.leaves.items()], betas=BETAS, eps=EPS
    )
    generator = torch.Generator().manual_seed(SEED)
    steps = rounds * len(looks)
    schedule = torch.optim.lr_scheduler.ExponentialLR(adam, LAST ** (1 / steps))
    for turn in range(rounds):
        for n, at in enumerate(torch.randperm(len(looks), generator=generator).tolist()):
            adam.zero_grad()
            learned.step(model, looks[at], at, behind)
            adam.step()
            learned.keep_coarse()
            schedule.step()
            progress((turn + (n + 1) / len(looks)) / rounds, f"fitting: round {turn + 1} of {rounds}")
        if turn < rounds - 1:
            learned.take_elsewhere(adam)
    return learned.gaussians()


class _Learned:
    """Gaussians as leaves; places as shifts from where they began, in units of their own size."""

    def __init__(self, gaussians: Gaussians, cameras: Sequence[Camera]) -> None:
        self.cameras = cameras
        self.nodes: Nodes | None = None
        self.start = gaussians.places.clone()
        self.unit = gaussians.log_scales.exp().mean(1, keepdim=True)
        self.leaves = {f.name: getattr(gaussians, f.name).clone() for f in fields(gaussians)}
        self.leaves["places"].zero_()
        for leaf in self.leaves.values():
            leaf.requires_grad_()
        self._forget()

    def gaussians(self) -> Gaussians:
        """As they are now, at rest."""
        parts = {name: leaf.detach() for name, leaf in self.leaves.items()}
        return Gaussians(**{**parts, "places": self.places().detach()})

    def places(self) -> Tensor:
        return self.start + self.unit * self.leaves["places"]

    def step(self, model: DynamicModel, look: ModelView, number: int, behind: Tensor) -> None:
        """Gradients of one picture's mean absolute difference."""
        places = self.places()
        now = Gaussians(**{**self.leaves, "places": places})
        if self.nodes is not None:
            now = self.nodes.at(number, now)
        else:
            now = now.at(places + (moved(model, places.detach(), look.time) - places.detach()))
        size = (look.camera.width, look.camera.height)
        flat, depth, spread = flattened(now, look.camera)
        flat.retain_grad()
        offsets, entries = tiles_of(flat.detach(), depth.detach(), spread.detach(), size)
        (splat(flat, offsets, entries, size, behind) - look.picture).abs().mean().backward()
        assert flat.grad is not None
        self.pull += flat.grad[:, :2].norm(dim=1)
        self.seen_px = torch.maximum(self.seen_px, flat.grad[:, 6:].abs().amax(1) * look.picture.numel())

    @torch.no_grad()
    def keep_coarse(self) -> None:
        """Hold the standard deviations to what pictures can show."""
        self.leaves["log_scales"].copy_(torch.maximum(self.leaves["log_scales"], self.finest))

    @torch.no_grad()
    def take_elsewhere(self, adam: torch.optim.Adam) -> None:
        """Give those that are not seen half of those that are pulled most."""
        unseen = (self.seen_px < UNSEEN_PX).nonzero()[:, 0]
        unseen = unseen[self.seen_px[unseen].argsort()[: int(MOST_TAKEN * len(self.start))]]
        self.pull[unseen] = -1
        wide = self.pull.argsort(descending=True)[: len(unseen)]
        now = self.gaussians()
        axes, which = now.axes[wide], now.log_scales[wide].argmax(1)
        along = CUT * axes[torch.arange(len(wide)), :, which]
        self.leaves["log_scales"][wide, which] += torch.log(torch.tensor(CUT))
        for leaf in self.leaves.values():
            leaf[unseen] = leaf[wide]
        if self.nodes is not None:
            self.nodes.part[unseen] = self.nodes.part[wide]
        middle = now.places[wide]
        self.start[wide], self.start[unseen] = middle + along, middle - along
        changed = torch.cat([wide, unseen])
        self.leaves["places"][changed] = 0
        self.unit[changed] = self.leaves["log_scales"][changed].exp().mean(1, keepdim=True)
        for leaf in self.leaves.values():
            for name in ("exp_avg", "exp_avg_sq"):
                adam.state[leaf][name][changed] = 0
        self._forget()

    @torch.no_grad()
    def _forget(self) -> None:
        self.finest = (FINEST_PX * pixel_sizes(self.places(), self.cameras)).log()[:, None]
        self.pull, self.seen_px = (torch.zeros_like(self.start[:, 0]) for _ in range(2))
