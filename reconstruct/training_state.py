"""What checkpoints hold of the parts that trainings share: grids with their trainers, modules and their optimisers."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from devrf.reconstruct.grids import BETAS, EPS, GridTrainer
from devrf.reconstruct.kernels.adam import dense_step


def grids_state(grids: Mapping[str, GridTrainer]) -> dict[str, Tensor]:
    """Values of grids, and what their later steps depend on, by name."""
    out: dict[str, Tensor] = {}
    for name, grid in grids.items():
        out |= {name: grid.values} | _named(f"{name} trainer", grid.state())
    return out


def take_up_grids(grids: Mapping[str, GridTrainer], tensors: dict[str, Tensor]) -> None:
    """Go on from a `grids_state` of grids of the same shapes; `visit` has to follow."""
    for name, grid in grids.items():
        grid.values.copy_(tensors[name])
        grid.take_up(_part_of(tensors, f"{name} trainer"))


class FlatAdam:
    """Adam's step on all parameters of a module at once: they become views of one vector, as their gradients do.

    `torch.optim` takes two seconds to import and several launches a parameter.
    """

    def __init__(self, module: nn.Module) -> None:
        self.module = module
        parameters = list(module.parameters())
        sizes = [p.numel() for p in parameters]
        device = parameters[0].device if parameters else None
        self.values, self.grad, self.moment1, self.moment2 = torch.zeros(4, sum(sizes), device=device)
        self.steps = 0
        views = zip(parameters, self.values.split(sizes), self.grad.split(sizes), strict=True)
        for parameter, values, grad in views if sizes else ():
            values.copy_(parameter.detach().reshape(-1))
            parameter.data, parameter.grad = values.view(parameter.shape), grad.view(parameter.shape)

    @torch.no_grad()
    def step(self, lr: float) -> None:
        """One step with the gradient that has gathered, which is cleared."""
        self.steps += 1
        dense_step(self.values, self.grad, self.moment1, self.moment2, self.steps, lr, BETAS, EPS)

    def forget(self) -> None:
        """Fresh moments."""
        self.steps = 0
        for vector in (self.grad, self.moment1, self.moment2):
            vector.zero_()


def net_state(adam: FlatAdam, of: str = "") -> dict[str, Tensor]:
    """A module's parameters, and moments and steps of its optimiser; `of` tells several apart."""
    moments = {"moment1": adam.moment1, "moment2": adam.moment2, "steps": torch.tensor(adam.steps)}
    return _named(f"{of}net", adam.module.state_dict()) | _named(f"{of}adam", moments)


def take_up_net(adam: FlatAdam, tensors: dict[str, Tensor], of: str = "") -> None:
    """Go on from a `net_state`."""
    adam.module.load_state_dict(_part_of(tensors, f"{of}net"))
    state = _part_of(tensors, f"{of}adam")
    adam.moment1.copy_(state["moment1"])
    adam.moment2.copy_(state["moment2"])
    adam.steps = int(state["steps"])


def _named(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of one part among those of a whole."""
    return {f"{name}.{key}": value for key, value in tensors.items()}


def _part_of(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of the part again."""
    start = f"{name}."
    return {key.removeprefix(start): value for key, value in tensors.items() if key.startswith(start)}
