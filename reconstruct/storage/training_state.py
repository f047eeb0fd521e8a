"""What checkpoints hold of the parts that trainings share: grids with their trainers, modules and their optimisers."""

from collections.abc import Mapping

import torch
from torch import Tensor

from devrf.reconstruct.fields.flat_adam import FlatAdam
from devrf.reconstruct.fields.grids import GridTrainer


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
