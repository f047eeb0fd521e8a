"""How an MLP, or another small module, is trained: Adam's step on all of its parameters in one launch."""

import torch
from torch import nn

from devrf.reconstruct.fields.grids import BETAS, EPS
from devrf.reconstruct.kernels.adam import dense_step


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
