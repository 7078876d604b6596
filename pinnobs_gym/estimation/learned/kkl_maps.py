"""The maps T and T* as multilayer perceptrons, in torch for training and in NumPy online."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.estimation.learned.perceptron import ACTIVATIONS, Layers, linear, perceptron

Activation: TypeAlias = Literal["tanh", "silu", "relu"]


@dataclass(frozen=True, eq=False)
class Scaling:
    """Affine maps between what a network is given and returns, and numbers of size one."""

    mean: np.ndarray
    """Of the inputs, shape (num_inputs,)."""
    root: np.ndarray
    """Square root of their covariance, (num_inputs, num_inputs)."""

    @staticmethod
    def of(samples: np.ndarray) -> Scaling:
        """That which makes samples (..., size) have mean zero and unit variance each."""
        flat = samples.reshape(int(np.prod(samples.shape[:-1])), samples.shape[-1])
        std = flat.std(axis=0)
        return Scaling(flat.mean(axis=0), np.diag(np.where(std > 0, std, 1.0)))

    @staticmethod
    def white(samples: np.ndarray, noise: np.ndarray) -> Scaling:
        """That which makes samples (..., size) with independent noise (..., size) added to them
        have mean zero and the identity as covariance."""
        flat, other = (a.reshape(-1, a.shape[-1]) for a in (samples, noise))
        spread = np.cov(flat.T) + other.T @ other / len(other)
        spread = np.atleast_2d(spread)
        spread += 1e-12 * np.diag(np.diag(spread))
        return Scaling(flat.mean(axis=0), np.linalg.cholesky(spread))

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Values (..., size) in numbers of size one."""
        return (values - self.mean) @ np.linalg.inv(self.root).T

    def beside(self, other: Scaling) -> Scaling:
        """That of both one after the other."""
        n, m = len(self.mean), len(other.mean)
        root = np.zeros((n + m, n + m))
        root[:n, :n], root[n:, n:] = self.root, other.root
        return Scaling(np.concatenate([self.mean, other.mean]), root)


class Mlp:
    """A multilayer perceptron between scaled numbers.

    The weights are drawn as Glorot & Bengio (2010) propose, the biases begin at zero.

    Args:
        inputs: scaling of what it is given.
        outputs: scaling of what it returns.
        depth: number of hidden layers.
        width: neurons in each.
        activation: of the hidden layers.
        generator: where the weights are drawn from.
        dtype: precision.
        device: where it lives.
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
        """Scaled outputs (..., num_outputs) of scaled inputs (..., num_inputs)."""
        layers = list(zip(self.parameters[::2], self.parameters[1::2], strict=True))
        return perceptron(layers, self.activation, a)

    def tangent(self, a: Tensor, da: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs and their directional derivative along da: a Jacobian-vector product that keeps
        its gradient with respect to the weights."""
        act = ACTIVATIONS[self.activation]
        *hidden, (W, b) = zip(self.parameters[::2], self.parameters[1::2], strict=True)
        for weight, bias in hidden:
            pre = linear(a, weight, bias)
            a, da = act(pre), self._slope(pre) * (da @ weight.T)
        return linear(a, W, b), da @ W.T

    def jacobian(self, a: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (batch, num_outputs) and their derivatives with respect to all weights and
        biases, (batch, num_outputs, num_parameters), in the order of ``parameters``."""
        act = ACTIVATIONS[self.activation]
        weights = [p.detach() for p in self.parameters]
        *hidden, (W, b) = zip(weights[::2], weights[1::2], strict=True)
        seen, slopes = [a], []
        for weight, bias in hidden:
            pre = linear(seen[-1], weight, bias)
            seen.append(act(pre))
            slopes.append(self._slope(pre)[:, None])
        out = linear(seen[-1], W, b)
        count, size = out.shape
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
        """What `jacobian` returns, and its directional derivative along da."""
        both: Any = torch.func.jvp(self.jacobian, (a,), (da,))
        return both

    def _slope(self, pre: Tensor) -> Tensor:
        if self.activation == "tanh":
            return 1 - torch.tanh(pre).square()
        if self.activation == "silu":
            gate = torch.sigmoid(pre)
            return gate * (1 + pre * (1 - gate))
        return (pre > 0).to(pre.dtype)

    def layers(self) -> Layers:
        """A copy of the weights for `perceptron`, the scalings taken into the outer layers."""
        arrays = [p.detach().double().cpu().numpy().copy() for p in self.parameters]
        W, b = arrays[0], arrays[1]
        W = np.linalg.solve(self.inputs.root.T, W.T).T
        arrays[0], arrays[1] = W, b - W @ self.inputs.mean
        arrays[-2] = self.outputs.root @ arrays[-2]
        arrays[-1] = self.outputs.root @ arrays[-1] + self.outputs.mean
        return tuple(zip(arrays[::2], arrays[1::2], strict=True))
