"""The network of PINN-Obs in plain torch, as a reference for ours."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from pinnobs_gym.estimation.learned.mlp import Architecture

_ACTIVATIONS = {
    "tanh": torch.tanh,
    "sine": torch.sin,
    "sigmoid": torch.sigmoid,
    "relu": torch.relu,
}


class Network(nn.Module):
    """Multilayer perceptron t ↦ (x̂(t), L(t)) (Farkane et al., PINN-Obs, "Proposed Adaptive
    PINN-Based Model").

    The initial weights are those of Glorot & Bengio (2010); the initial biases are zero.

    Args:
        architecture: architecture of the network.
        generator: random generator of the weights; one with seed 0 if None.
    """

    def __init__(
        self, architecture: Architecture, generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        generator = generator or torch.Generator().manual_seed(0)
        self.architecture, dtype = architecture, architecture.torch_dtype
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_out, fan_in in architecture.shapes:
            weight = torch.empty(fan_out, fan_in, dtype=dtype)
            self.weights.append(nn.init.xavier_normal_(weight, generator=generator))
            self.biases.append(torch.zeros(fan_out, dtype=dtype))
        scale = architecture.scale
        self._scale = torch.tensor(1.0 if scale is None else scale, dtype=dtype)

    @property
    def layers(self) -> list[tuple[Tensor, Tensor]]:
        """Return the weights and biases of each layer."""
        return list(zip(self.weights, self.biases, strict=True))

    def forward(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return x̂ (..., nx) in state units and L (..., nx, ny) at times t (...) in s."""
        *hidden, (weight, bias) = self.layers
        a, _ = self.architecture.features(t)
        for W, b in hidden:
            a = _ACTIVATIONS[self.architecture.activation](nn.functional.linear(a, W, b))
        out = nn.functional.linear(a, weight, bias) * self._scale
        nx, ny = self.architecture.nx, self.architecture.ny
        return out[..., :nx], out[..., nx:].unflatten(-1, (nx, ny))
