"""Forward and reverse passes of a network and its time derivative, derived by hand.

At a few thousand points and twenty neurons torch spends most of its time on overhead and on the
allocation of arrays. NumPy is several times faster here: the time derivative is propagated forward
with the values, one reverse pass gives the gradient, and arrays are reused. On a GPU the same code
evaluates many networks at once in torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from array_api_compat import array_namespace, device

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.simulation.system import Array

_CHUNK = 2000
"""Columns per block of a matrix product with a small result, so that blocks fit into the cache."""


def _tanh(z: Array, value: Array, slope: Array, bend: Array) -> None:
    xp = array_namespace(z)
    xp.tanh(z, out=value)
    xp.multiply(value, value, out=slope)
    slope *= -1
    slope += 1
    xp.multiply(value, slope, out=bend)
    bend *= -2


def _sine(z: Array, value: Array, slope: Array, bend: Array) -> None:
    xp = array_namespace(z)
    xp.sin(z, out=value)
    xp.cos(z, out=slope)
    bend[...] = -value


def _sigmoid(z: Array, value: Array, slope: Array, bend: Array) -> None:
    value[...] = 0.5 + 0.5 * array_namespace(z).tanh(0.5 * z)
    slope[...] = value * (1 - value)
    bend[...] = slope * (1 - 2 * value)


def _relu(z: Array, value: Array, slope: Array, bend: Array) -> None:
    slope[...] = z > 0
    value[...] = z * slope
    bend[...] = 0


_ACTIVATIONS: dict[str, Callable[[Array, Array, Array, Array], None]] = {
    "tanh": _tanh,
    "sine": _sine,
    "sigmoid": _sigmoid,
    "relu": _relu,
}
"""Activations by name; each writes its value and its first and second derivative at z into the
other arguments."""


def draw_layers(
    architecture: Architecture, generator: torch.Generator
) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Draw initial layers: weights (fan_out, fan_in) by Glorot & Bengio (2010, "Xavier" normal),
    and zero biases (fan_out,)."""
    dtype, layers = architecture.torch_dtype, []
    for fan_out, fan_in in architecture.shapes:
        weight = torch.empty(fan_out, fan_in, dtype=dtype)
        torch.nn.init.xavier_normal_(weight, generator=generator)
        layers.append((weight, torch.zeros(fan_out, dtype=dtype)))
    return layers


def flattened(layers: Sequence[tuple[torch.Tensor, torch.Tensor]]) -> np.ndarray:
    """Flatten the layers of a network to one vector (n,).

    It holds, layer by layer, the rows of the weights, each followed by its bias.
    """
    rows = [torch.cat([W, b[:, None]], dim=1).flatten() for W, b in layers]
    return torch.cat(rows).detach().numpy()


def unflattened(architecture: Architecture, theta: np.ndarray) -> Layers:
    """Return copies of the weights and biases of each layer in theta (n,)."""
    parts = _layers(architecture, theta)
    return tuple((part[:, :-1].copy(), part[:, -1].copy()) for part in parts)


def inputs_of(architecture: Architecture, t: np.ndarray) -> np.ndarray:
    """Return the inputs of the first layer at times t (num_points,) in s, and then their time
    derivatives; shape (num_features, 2 · num_points)."""
    # In double precision: late times of a log are differences of large numbers.
    value, rate = architecture.features(t.astype(float))
    return np.concatenate([value.T, rate.T], axis=1).astype(architecture.dtype)


def _layers(architecture: Architecture, theta: Array) -> list[Array]:
    """Return views (..., fan_out, fan_in + 1) of theta (..., n): each layer's weights, with its
    biases as the last column."""
    layers, place = [], 0
    for out, fan_in in architecture.shapes:
        size = out * (fan_in + 1)
        part = theta[..., place : place + size]
        layers.append(part.reshape(*theta.shape[:-1], out, fan_in + 1))
        place += size
    return layers


class Passes:
    """Forward and reverse pass at fixed times, of one network or of a batch (...) of networks.

    Values and time derivatives are the two halves of arrays (..., neurons, 2 · num_points). Below
    them is a row of ones and zeros, by which the biases are multiplied. The result of a pass is
    overwritten by the next pass.

    Args:
        architecture: architecture of the networks; its times and scale are ignored.
        inputs: see `inputs_of`, shape (..., num_features, 2 · num_points); they determine the
            library, precision and device.
        scale: factors of the networks' outputs, shape (..., nx + nx·ny).
    """

    def __init__(self, architecture: Architecture, inputs: Array, scale: Array) -> None:
        self._architecture, self._scale = architecture, scale[..., None]
        self._activation = _ACTIVATIONS[architecture.activation]
        xp, batch, points = array_namespace(inputs), inputs.shape[:-2], inputs.shape[-1]

        def empty(*shape: int) -> Array:
            return xp.empty((*batch, *shape), dtype=inputs.dtype, device=device(inputs))

        shapes, self._num_points = architecture.shapes, points // 2
        self._seen = [empty(fan_in + 1, points) for _, fan_in in shapes]
        for seen in self._seen:
            seen[..., -1, : self._num_points], seen[..., -1, self._num_points :] = 1, 0
        self._seen[0][..., :-1, :] = inputs
        hidden = [width for width, _ in shapes[:-1]]
        self._slopes = [empty(width, self._num_points) for width in hidden]
        self._bends = [empty(width, self._num_points) for width in hidden]
        self._work = [empty(architecture.width, points) for _ in range(2)]
        self._out = empty(shapes[-1][0], points)

    def forward(self, theta: Array) -> tuple[Array, Array]:
        """Return the networks' outputs (..., nx + nx·ny, num_points) at weights theta (..., n), and
        the time derivatives of the first nx outputs (..., nx, num_points)."""
        n, nx, xp = self._num_points, self._architecture.nx, array_namespace(theta)
        self._weights = _layers(self._architecture, theta)
        z = self._work[0]
        for k, weights in enumerate(self._weights[:-1]):
            xp.matmul(weights, self._seen[k], out=z)
            above, slope, bend = self._seen[k + 1][..., :-1, :], self._slopes[k], self._bends[k]
            self._activation(z[..., :n], above[..., :n], slope, bend)
            xp.multiply(slope, z[..., n:], out=above[..., n:])  # chain rule in time
            bend *= z[..., n:]  # derivative of the rate by z, for the reverse pass
        out = xp.matmul(self._weights[-1], self._seen[-1], out=self._out)
        out *= self._scale
        return out[..., :n], out[..., :nx, n:]

    def reverse(self, by_out: Array, by_rate: Array) -> Array:
        """Return the gradient (..., n) of a loss by the weights.

        Args:
            by_out: derivatives of the loss by the first result of the last `forward`.
            by_rate: derivatives by its second result.
        """
        n, nx, xp = self._num_points, self._architecture.nx, array_namespace(by_out)
        # Derivatives by the last layer; the rates of the gains do not enter the loss.
        by_z = self._out
        by_z[..., :n], by_z[..., :nx, n:], by_z[..., nx:, n:] = by_out, by_rate, 0
        by_z *= self._scale
        size = sum(out * (fan_in + 1) for out, fan_in in self._architecture.shapes)
        shape = (*by_z.shape[:-2], size)
        gradient = xp.empty(shape, dtype=by_z.dtype, device=device(by_z))
        parts = _layers(self._architecture, gradient)
        for k in range(len(parts) - 1, 0, -1):
            # By the weights of layer k, by its inputs, and through the activation below, whose
            # slope depends on z, too.
            _outer(by_z, self._seen[k], parts[k])
            by_a = self._work[k % 2]
            xp.matmul(self._weights[k][..., :-1].mT, by_z, out=by_a)
            slope, bend = self._slopes[k - 1], self._bends[k - 1]
            bend *= by_a[..., n:]
            by_a[..., :n] *= slope
            by_a[..., :n] += bend
            by_a[..., n:] *= slope
            by_z = by_a
        _outer(by_z, self._seen[0], parts[0])
        return gradient


def _outer(by_z: Array, seen: Array, out: Array) -> None:
    """Compute by_z · seenᵀ in blocks of columns."""
    out[...] = by_z[..., :_CHUNK] @ seen[..., :_CHUNK].mT
    for start in range(_CHUNK, seen.shape[-1], _CHUNK):
        out += by_z[..., start : start + _CHUNK] @ seen[..., start : start + _CHUNK].mT
