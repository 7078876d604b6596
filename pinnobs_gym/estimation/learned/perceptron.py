"""The multilayer perceptron of learned estimators and their trainers, in NumPy and torch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.system import Array

Layers: TypeAlias = tuple[tuple[np.ndarray, np.ndarray], ...]
"""Weights (fan_out, fan_in) and biases (fan_out,) of each layer."""


def _tanh(z: Array) -> Array:
    return array_namespace(z).tanh(z)


def _sine(z: Array) -> Array:
    return array_namespace(z).sin(z)


def _sigmoid(z: Array) -> Array:
    return 0.5 + 0.5 * array_namespace(z).tanh(0.5 * z)


def _silu(z: Array) -> Array:
    return z * _sigmoid(z)


def _relu(z: Array) -> Array:
    return z * (z > 0)


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "tanh": _tanh,
    "sine": _sine,
    "sigmoid": _sigmoid,
    "silu": _silu,
    "relu": _relu,
}
"""Activation functions by name."""


def perceptron(layers: Sequence[tuple[Array, Array]], activation: str, a: Array) -> Array:
    """Return the outputs (..., num_outputs) at inputs a (..., num_inputs).

    Args:
        layers: weights (fan_out, fan_in) and biases (fan_out,) of each layer, of the library of a.
        activation: activation of all layers but the last, which is linear.
        a: inputs.
    """
    *hidden, last = layers
    for layer in hidden:
        a = ACTIVATIONS[activation](linear(a, *layer))
    return linear(a, *last)


def linear(a: Array, W: Array, b: Array) -> Array:
    """Return Wa + b for each row of a (..., fan_in), shape (..., fan_out)."""
    if isinstance(a, np.ndarray):
        out = a @ W.T
        out += b  # in place, without another array
        return out
    import torch

    return torch.nn.functional.linear(a, W, b)
