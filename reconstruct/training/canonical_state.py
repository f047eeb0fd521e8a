"""What stage 1 trains: the scene at rest and its surroundings, the trainers of their grids and of the MLP."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from devrf.reconstruct.fields.canonical import EMPTY, Canonical, refine
from devrf.reconstruct.fields.contracted_background import Shell
from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.fields.grids import GridTrainer
from devrf.reconstruct.kernels.launch import copies_for
from devrf.reconstruct.rendering.render import Grads
from devrf.reconstruct.storage.training_state import grids_state, net_state, take_up_grids, take_up_net

Hull = tuple[Bool[Tensor, "X Y Z"], Float[Tensor, "2 3"]]
"""Vertices at which the subject can be, and the box that they fill."""


@dataclass
class CanonicalState:
    """Fields and optimisers.

    Attributes:
        canonical: The scene at rest.
        shell: Its surroundings; None before a plain background.
        hull: Where the subject can be; None where that is not known.
        density, features, surround: Trainers of the grids.
        net: Optimiser of the MLP.
    """

    canonical: Canonical
    shell: Shell | None
    hull: Hull | None
    net: FlatAdam = field(init=False)
    density: GridTrainer = field(init=False)
    features: GridTrainer = field(init=False)
    surround: GridTrainer | None = field(init=False)

    def __post_init__(self) -> None:
        self.net = FlatAdam(self.canonical.net)
        self.restart()

    def restart(self) -> None:
        """Fresh moments for grids that are new or have been replaced."""
        self._new_trainers()
        self.find_reachable()

    def refine(self, resolution: float, shell_size: int) -> None:
        """More vertices, fresh moments."""
        del self.density, self.features, self.surround  # their memory is what the next resolution needs
        refine(self.canonical, resolution)
        if self.shell is not None:
            self.shell.refine(shell_size)
        self.restart()

    def grids(self) -> dict[str, GridTrainer]:
        """The trainers, by name."""
        grids = {"density": self.density, "features": self.features}
        return grids if self.surround is None else grids | {"surround": self.surround}

    def grads(self) -> Grads:
        """Where gradients are added."""
        around = None if self.surround is None else self.surround.grad
        return self.density.grad[0], self.features.grad[0], around

    def values(self) -> dict[str, Tensor]:
        """All that is trained, by name."""
        values = {name: grid.values for name, grid in self.grids().items()}
        return values | {f"net.{name}": x for name, x in self.canonical.net.state_dict().items()}

    def forget(self) -> None:
        """Fresh moments for grids whose values are others; the occupancy is looked at anew."""
        for grid in self.grids().values():
            grid.forget()
        self.net.forget()
        self.find_reachable()

    def tensors(self) -> dict[str, Tensor]:
        """Everything that later steps depend on."""
        tensors = {"distance": self.canonical.distance} | net_state(self.net) | grids_state(self.grids())
        return tensors if self.shell is None else tensors | {"surround distance": self.shell.distance}

    def take_up(self, tensors: dict[str, Tensor]) -> None:
        """Go on from `tensors`."""
        device, target = self.canonical.density.device, self.canonical
        target.density, target.features = (
            torch.empty_like(tensors[name], device=device) for name in ("density", "features")
        )
        target.distance = tensors["distance"].to(device)
        if self.shell is not None:
            self.shell.grid = torch.empty_like(tensors["surround"], device=device)
            self.shell.distance = tensors["surround distance"].to(device)
        take_up_net(self.net, tensors)
        self._new_trainers()
        take_up_grids(self.grids(), tensors)
        _visit(self, target.reachable(), None if self.shell is None else self.shell.reachable())

    def find_reachable(self) -> None:
        """Look again at what is empty."""
        within = None if self.hull is None else _within(self.hull, self.canonical)
        around = None if self.shell is None else self.shell.rebuild_occupancy()
        _visit(self, self.canonical.rebuild_occupancy(within), around)

    def clear_untouched(self) -> None:
        """What no ray has passed in this level is taken to be empty, not translucent."""
        self.canonical.density[..., 0][~self.density.touched()] = EMPTY
        if self.shell is not None and self.surround is not None:
            touched = (self.surround.moment2[..., 0] > 0)[..., None]
            self.shell.grid[..., :1] = torch.where(touched, self.shell.grid[..., :1], EMPTY)

    def _new_trainers(self) -> None:
        self.density, self.features = (
            GridTrainer(self.canonical.density),
            GridTrainer(self.canonical.features),
        )
        self.surround = None
        if self.shell is not None:
            self.surround = GridTrainer(self.shell.grid, copies_for(self.shell.grid.device))


def _visit(
    state: CanonicalState, reachable: Bool[Tensor, "X Y Z"], around: Bool[Tensor, "N N N"] | None
) -> None:
    """Say which vertices steps visit from now on."""
    state.density.visit(reachable)
    state.features.reachable = state.density.reachable
    if state.surround is not None and around is not None:
        state.surround.visit(around)


def _within(hull: Hull, canonical: Canonical) -> Tensor:
    """Vertices of the present grid that lie in the hull."""
    kept, box = hull
    shape = torch.tensor(kept.shape)
    index = []
    for axis in range(3):
        lo, hi = float(canonical.aabb[0, axis]), float(canonical.aabb[1, axis])
        x = torch.linspace(lo, hi, canonical.shape[axis])
        at = (x - box[0, axis]) / (box[1, axis] - box[0, axis]) * (shape[axis] - 1)
        index.append(at.round().long().clamp(0, int(shape[axis]) - 1))
    return kept[index[0]][:, index[1]][:, :, index[2]].to(canonical.density.device)
