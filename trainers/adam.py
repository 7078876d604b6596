"""Adam on tensors (Kingma & Ba, "Adam: A Method for Stochastic Optimization", 2015)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

MEAN, SQUARE = 0.9, 0.999
"""β₁ and β₂, the decay rates of the two moving averages."""
EPSILON = 1e-8


class Adam:
    """A minimisation in progress, which moves parameters in place against their gradients.

    It moves them exactly as torch.optim.Adam does, which would import torch's compiler, more code
    than all the rest of torch.

    Args:
        parameters: the parameters, leaf tensors that require gradients.
    """

    def __init__(self, parameters: Sequence[Tensor]) -> None:
        self._parameters = list(parameters)
        self._means = [torch.zeros_like(p) for p in self._parameters]
        self._squares = [torch.zeros_like(p) for p in self._parameters]
        self._steps = 0

    def clear(self) -> None:
        """Delete the gradients, which would otherwise add up."""
        for parameter in self._parameters:
            parameter.grad = None

    @torch.no_grad()
    def step(self, learning_rate: float) -> None:
        """Make a step of this size against the gradients. A parameter without one, on which the
        loss does not depend, has the gradient 0."""
        self._steps += 1
        size = learning_rate / (1 - MEAN**self._steps)
        root = (1 - SQUARE**self._steps) ** 0.5
        for p, mean, square in zip(self._parameters, self._means, self._squares, strict=True):
            gradient = torch.zeros_like(p) if p.grad is None else p.grad
            mean.lerp_(gradient, 1 - MEAN)
            square.mul_(SQUARE).addcmul_(gradient, gradient, value=1 - SQUARE)
            p.addcdiv_(mean, (square.sqrt() / root).add_(EPSILON), value=-size)

    def state(self) -> dict[str, Any]:
        """Return the state of the minimisation, without the parameters, as arrays."""
        means, squares = (
            [tensor.cpu().numpy().copy() for tensor in tensors]
            for tensors in (self._means, self._squares)
        )
        return {"steps": self._steps, "means": means, "squares": squares}

    @torch.no_grad()
    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`."""
        self._steps = state["steps"]
        for name, tensors in (("means", self._means), ("squares", self._squares)):
            for tensor, kept in zip(tensors, state[name], strict=True):
                tensor.copy_(torch.as_tensor(kept))
