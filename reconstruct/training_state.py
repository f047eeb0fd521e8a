"""What checkpoints hold of the parts that trainings share: grids with their trainers, modules and their optimisers."""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from devrf.reconstruct.grids import GridTrainer


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


def net_state(net: nn.Module, optimiser: torch.optim.Adam, of: str = "") -> dict[str, Tensor]:
    """An MLP's (or another module's) parameters, and moments and steps of its optimiser; `of` tells several apart."""
    out = _named(f"{of}net", net.state_dict())
    for number, moments in optimiser.state_dict()["state"].items():
        out |= _named(f"{of}adam.{number}", moments)
    return out


def take_up_net(
    net: nn.Module, optimiser: torch.optim.Adam, tensors: dict[str, Tensor], of: str = ""
) -> None:
    """Go on from a `net_state`."""
    net.load_state_dict(_part_of(tensors, f"{of}net"))
    state = optimiser.state_dict()
    for number in range(len(list(net.parameters()))):
        if moments := _part_of(tensors, f"{of}adam.{number}"):
            state["state"][number] = moments
    optimiser.load_state_dict(state)


def _named(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of one part among those of a whole."""
    return {f"{name}.{key}": value for key, value in tensors.items()}


def _part_of(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of the part again."""
    start = f"{name}."
    return {key.removeprefix(start): value for key, value in tensors.items() if key.startswith(start)}
