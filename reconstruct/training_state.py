"""What checkpoints hold of the parts that trainings share: named tensors, an MLP and its optimiser."""

import torch
from torch import Tensor, nn


def named(name: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors of one part among those of a whole."""
    return {f"{name}.{key}": value for key, value in tensors.items()}


def part_of(tensors: dict[str, Tensor], name: str) -> dict[str, Tensor]:
    """Those of the part again."""
    start = f"{name}."
    return {key.removeprefix(start): value for key, value in tensors.items() if key.startswith(start)}


def net_state(net: nn.Module, optimiser: torch.optim.Adam) -> dict[str, Tensor]:
    """An MLP's parameters, and moments and steps of its optimiser."""
    out = named("net", net.state_dict())
    for number, moments in optimiser.state_dict()["state"].items():
        out |= named(f"adam.{number}", moments)
    return out


def take_up_net(net: nn.Module, optimiser: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    """Go on from a `net_state`."""
    net.load_state_dict(part_of(tensors, "net"))
    state = optimiser.state_dict()
    for number in range(len(list(net.parameters()))):
        if moments := part_of(tensors, f"adam.{number}"):
            state["state"][number] = moments
    optimiser.load_state_dict(state)
