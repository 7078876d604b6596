"""The maps T and T* as multilayer perceptrons: torch in training, NumPy online."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.perceptron import ACTIVATIONS, Layers, linear, perceptron

Activation: TypeAlias = Literal["tanh", "silu", "relu"]
"""Activation of hidden layers."""


@dataclass(frozen=True, eq=False)
class Scaling:
    """Affine map that standardises the inputs or outputs of a network."""

    mean: np.ndarray
    """Mean of the values, shape (size,)."""
    root: np.ndarray
    """Square root of their covariance, shape (size, size)."""

    @staticmethod
    def of(samples: np.ndarray) -> Scaling:
        """Return the scaling to zero mean and unit variances of samples (..., size)."""
        flat = samples.reshape(int(np.prod(samples.shape[:-1])), samples.shape[-1])
        std = flat.std(axis=0)
        return Scaling(flat.mean(axis=0), np.diag(np.where(std > 0, std, 1.0)))

    @staticmethod
    def white(samples: np.ndarray, noise: np.ndarray) -> Scaling:
        """Return the whitening of samples (..., size) with independent noise (..., size) added."""
        flat, other = (a.reshape(-1, a.shape[-1]) for a in (samples, noise))
        spread = np.cov(flat.T) + other.T @ other / len(other)
        spread = np.atleast_2d(spread)
        spread += 1e-12 * np.diag(np.diag(spread))
        return Scaling(flat.mean(axis=0), np.linalg.cholesky(spread))

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Standardise values (..., size)."""
        return (values - self.mean) @ np.linalg.inv(self.root).T

    def beside(self, other: Scaling) -> Scaling:
        """Return the scaling of this scaling's values followed by the other's."""
        n, m = len(self.mean), len(other.mean)
        root = np.zeros((n + m, n + m))
        root[:n, :n], root[n:, n:] = self.root, other.root
        return Scaling(np.concatenate([self.mean, other.mean]), root)


def _silu_slope(pre: Tensor) -> Tensor:
    gate = torch.sigmoid(pre)
    return gate * (1 + pre * (1 - gate))


_SLOPES: dict[str, Callable[[Tensor], Tensor]] = {
    "tanh": lambda pre: 1 - torch.tanh(pre).square(),
    "silu": _silu_slope,
    "relu": lambda pre: (pre > 0).to(pre.dtype),
}
"""Derivatives of the activations of `Activation`, by name."""


class Mlp:
    """Multilayer perceptron between scaled inputs and scaled outputs.

    The initial weights are those of Glorot & Bengio (2010); the initial biases are zero.

    Args:
        inputs: scaling of the inputs.
        outputs: scaling of the outputs.
        depth: number of hidden layers.
        width: neurons in each hidden layer.
        activation: activation of the hidden layers.
        generator: random generator of the weights.
        dtype: precision.
        device: device of the parameters.

    Raises:
        ValueError: in one line, if the activation is unknown.
    """

    def __init__(
        self,
        inputs: Scaling,
        outputs: Scaling,
        depth: int,
        width: int,
        activation: Activation,
        generator: torch.Generator,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        if activation not in _SLOPES:
            expected = ", ".join(_SLOPES)
            raise ValueError(f"activation={activation!r}; expected one of {expected}")
        self.inputs, self.outputs = inputs, outputs
        self.activation = activation
        sizes = [len(inputs.mean), *[width] * depth, len(outputs.mean)]
        self.parameters: list[Tensor] = []
        for fan_in, fan_out in pairwise(sizes):
            weight = torch.randn(fan_out, fan_in, generator=generator, dtype=torch.float64)
            weight *= (2 / (fan_in + fan_out)) ** 0.5
            for values in (weight, torch.zeros(fan_out, dtype=torch.float64)):
                self.parameters.append(values.to(device, dtype).requires_grad_())

    def __call__(self, a: Tensor) -> Tensor:
        """Return the scaled outputs (..., num_outputs) at scaled inputs (..., num_inputs)."""
        layers = list(zip(self.parameters[::2], self.parameters[1::2], strict=True))
        return perceptron(layers, self.activation, a)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs and their directional derivative along da.

        The Jacobian-vector product is differentiable with respect to the weights.
        """
        act = ACTIVATIONS[self.activation]
        *hidden, (W, b) = zip(self.parameters[::2], self.parameters[1::2], strict=True)
        for weight, bias in hidden:
            pre = linear(a, weight, bias)
            a, da = act(pre), self._slope(pre) * (da @ weight.T)
        return linear(a, W, b), da @ W.T

    def jacobian(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs (batch, num_outputs) and their Jacobian by all weights and biases,
        (batch, num_outputs, num_parameters), in the order of ``parameters``."""
        act = ACTIVATIONS[self.activation]
        weights = [p.detach() for p in self.parameters]
        *hidden, (W, b) = zip(weights[::2], weights[1::2], strict=True)
        # Forward pass, with the activations and their slopes.
        seen, slopes = [a], []
        for weight, bias in hidden:
            pre = linear(seen[-1], weight, bias)
            seen.append(act(pre))
            slopes.append(self._slope(pre)[:, None])
        out = linear(seen[-1], W, b)
        count, size = out.shape
        # Backpropagation of all outputs at once, from the last layer to the first.
        back = torch.eye(size, dtype=a.dtype, device=a.device).expand(count, size, size)
        blocks: list[Tensor] = []
        for layer in reversed(range(len(hidden) + 1)):
            by_weight = back[..., None] * seen[layer][:, None, None, :]
            blocks += [back, by_weight.reshape(count, size, -1)]
            if layer:
                back = (back @ weights[2 * layer]) * slopes[layer - 1]
        return out, torch.cat(blocks[::-1], dim=-1)

    def tangent_jacobian(
        self, a: Tensor, da: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return the result of `jacobian`, and its directional derivative along da."""
        both: Any = torch.func.jvp(self.jacobian, (a,), (da,))
        return both

    def _slope(self, pre: Tensor) -> Tensor:
        """Return the derivative of the activation."""
        return _SLOPES[self.activation](pre)

    def layers(self) -> Layers:
        """Return a copy of the weights for `perceptron`, with the scalings merged into the first
        and last layer."""
        arrays = [p.detach().double().cpu().numpy().copy() for p in self.parameters]
        W, b = arrays[0], arrays[1]
        W = np.linalg.solve(self.inputs.root.T, W.T).T
        arrays[0], arrays[1] = W, b - W @ self.inputs.mean
        arrays[-2] = self.outputs.root @ arrays[-2]
        arrays[-1] = self.outputs.root @ arrays[-1] + self.outputs.mean
        return tuple(zip(arrays[::2], arrays[1::2], strict=True))
