"""Splats of a trained model: looked for, fitted, and where they are at each time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from devrf.capture.scene import Scene, plain_colour
from devrf.capture.system.progress import Progress, no_progress, part
from devrf.reconstruct.rendering.model import DynamicModel
from devrf.reconstruct.splats.fit import fit
from devrf.reconstruct.splats.gaussians import Gaussians
from devrf.reconstruct.splats.looks import look_around
from devrf.reconstruct.splats.moving import Nodes, moved, nodes_of
from devrf.reconstruct.splats.sample import sample

ROUNDS = 4  # of fitting, through all pictures
SEED = 0  # of everything that is drawn
LOOKING = 0.4  # of the whole time
STILL = 0.25  # of its mean standard deviation: a splat that never goes farther does not move
FAINTEST = 0.02  # opacity below which a splat is left out


@dataclass(frozen=True)
class Splats:
    """Splats of a scene.

    Attributes:
        gaussians: At rest, in the box frame; those that move come first.
        ways: Places of those that move, at each of the times; also where they are on nodes.
        behind: RGB of what is behind all of them.
        nodes: Rigid parts at these times, where motion is theirs.
    """

    gaussians: Gaussians
    ways: Float[Tensor, "K M 3"]
    behind: Float[Tensor, " 3"]
    nodes: Nodes | None = None

    @property
    def moving(self) -> int:
        """How many move."""
        return self.ways.shape[1]

    def at(self, key: int) -> Gaussians:
        """As they are at one of the times."""
        if self.nodes is not None:
            return self.nodes.at(key, self.gaussians)
        return self.gaussians.at(torch.cat([self.ways[key], self.gaussians.places[self.moving :]]))


def make_splats(
    scene: Scene,
    model: DynamicModel,
    count: int,
    times: Sequence[float | None],
    progress: Progress = no_progress,
    *,
    rounds: int = ROUNDS,
) -> Splats:
    """About `count` splats of a model, and where they are at some times.

    Args:
        scene: In the box frame.
        model: As it is rendered.
        count: At most so many.
        times: In [0, 1], in order; None where nothing moves.
        progress: To be called with (fraction done, short text).
        rounds: Of fitting; 0: they stay as they were sampled.
    Raises:
        ReconstructError: The model shows no surface.
    """
    behind = behind_of(scene).to(model.rest.canonical.density.device)
    placed, others = look_around(scene, model, part(progress, 0.0, LOOKING))
    gaussians = sample(placed, count, SEED)
    fitting = part(progress, LOOKING, 1 - LOOKING)
    nodes = nodes_of(model, gaussians.places, times)
    if rounds:
        gaussians = fit(model, (gaussians, nodes), [*placed, *others], behind, rounds, fitting)
    kept = (gaussians.logits.sigmoid() > FAINTEST).nonzero()[:, 0]
    return along(model, gaussians.only(kept), times, behind, nodes and replace(nodes, part=nodes.part[kept]))


def along(
    model: DynamicModel,
    gaussians: Gaussians,
    times: Sequence[float | None],
    behind: Float[Tensor, " 3"],
    nodes: Nodes | None,
) -> Splats:
    """Resting splats with their places at some times; those that stay where they are come last."""
    if nodes is None:
        ways = torch.stack([moved(model, gaussians.places, time) for time in times])
        moves = (ways - gaussians.places).norm(dim=2).amax(0) > STILL * gaussians.log_scales.exp().mean(1)
        ways = ways[:, moves]
    else:
        moves = nodes.part > 0
        mine, on = gaussians.only(moves.nonzero()[:, 0]), replace(nodes, part=nodes.part[moves])
        ways = torch.stack([on.at(key, mine).places for key in range(len(times))])
    order = torch.cat([moves.nonzero()[:, 0], (~moves).nonzero()[:, 0]])
    return Splats(gaussians.only(order), ways, behind, nodes and replace(nodes, part=nodes.part[order]))


def behind_of(scene: Scene) -> Float[Tensor, " 3"]:
    """The plain colour behind a scene; black behind modelled surroundings, which leave nothing open."""
    return torch.from_numpy(np.array(plain_colour(scene.background) or (0.0, 0.0, 0.0), np.float32))
