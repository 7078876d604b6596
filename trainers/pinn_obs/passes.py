"""A network and its time derivative, forward and in reverse, in NumPy and written out by hand.

At a few thousand points and twenty neurons torch spends its time on overhead and on arrays made
anew; the same sums with the derivative carried forward through the layers, one reverse pass and
arrays that are used again take a fraction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from pinnobs_gym.network import Architecture, Network

_CHUNK = 2000
"""Columns of a matrix product whose result is small; more of them fall out of the cache."""


def _tanh(z: np.ndarray, value: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> None:
    np.tanh(z, out=value)
    np.multiply(value, value, out=slope)
    np.subtract(1, slope, out=slope)
    np.multiply(value, slope, out=bend)
    bend *= -2


def _sine(z: np.ndarray, value: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> None:
    np.sin(z, out=value)
    np.cos(z, out=slope)
    np.negative(value, out=bend)


def _sigmoid(z: np.ndarray, value: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> None:
    value[...] = 0.5 + 0.5 * np.tanh(0.5 * z)
    np.multiply(value, 1 - value, out=slope)
    np.multiply(slope, 1 - 2 * value, out=bend)


def _relu(z: np.ndarray, value: np.ndarray, slope: np.ndarray, bend: np.ndarray) -> None:
    slope[...] = z > 0
    np.multiply(z, slope, out=value)
    bend[...] = 0


_ACTIVATIONS: dict[str, Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], None]] = {
    "tanh": _tanh,
    "sine": _sine,
    "sigmoid": _sigmoid,
    "relu": _relu,
}
"""Each activation at z, written with its first and second derivative into the other three."""


def strung(network: Network) -> np.ndarray:
    """All weights of a network in one vector (n,): layer by layer the rows of its weights, each
    with its bias at the end."""
    pairs = zip(network.weights, network.biases, strict=True)
    rows = [torch.cat([W, b[:, None]], dim=1).flatten() for W, b in pairs]
    return torch.cat(rows).detach().numpy()


def unstrung(architecture: Architecture, theta: np.ndarray) -> Network:
    """The network with weights theta (n,)."""
    network = Network(architecture)
    with torch.no_grad():
        for k, layer in enumerate(_layers(architecture, theta)):
            network.weights[k].copy_(torch.from_numpy(layer[:, :-1]))
            network.biases[k].copy_(torch.from_numpy(layer[:, -1]))
    return network


def _layers(architecture: Architecture, theta: np.ndarray) -> list[np.ndarray]:
    """Views (..., out, in + 1) of theta (..., n): a layer's weights, and its biases as the last
    column."""
    layers, place = [], 0
    for out, fan_in in architecture.shapes:
        size = out * (fan_in + 1)
        part = theta[..., place : place + size]
        layers.append(part.reshape(*theta.shape[:-1], out, fan_in + 1))
        place += size
    return layers


class Passes:
    """The two passes at fixed times.

    Values and time derivatives lie side by side, (neurons, 2 · num_points), and under them a row of
    one and zero, which the biases multiply. What a pass returns is overwritten by the next.

    Args:
        architecture: the network's.
        t: times in s, shape (num_points,).
    """

    def __init__(self, architecture: Architecture, t: np.ndarray) -> None:
        self._architecture, n = architecture, len(t)
        dtype = np.dtype(architecture.dtype)
        self._activation = _ACTIVATIONS[architecture.activation]
        *hidden, (outputs, _) = architecture.shapes
        scale = architecture.scale or (1.0,) * outputs
        self._scale = np.asarray(scale, dtype)[:, None]
        fans = [fan_in for _, fan_in in architecture.shapes]
        self._seen = [np.zeros((fan_in + 1, 2 * n), dtype) for fan_in in fans]
        for seen in self._seen:
            seen[-1, :n] = 1
        value, rate = architecture.features(t.astype(dtype))
        self._seen[0][:-1] = np.concatenate([value.T, rate.T], axis=1)
        self._slopes, self._bends = np.empty((2, len(hidden), architecture.width, n), dtype)
        self._work = np.empty((2, architecture.width, 2 * n), dtype)
        self._out = np.empty((outputs, 2 * n), dtype)

    def forward(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The network's outputs (nx + nx·ny, num_points) at weights theta (n,), and the time
        derivatives of the first nx of them (nx, num_points)."""
        n, nx = self._out.shape[-1] // 2, self._architecture.nx
        self._weights = _layers(self._architecture, theta)
        z = self._work[0]
        for k, weights in enumerate(self._weights[:-1]):
            np.matmul(weights, self._seen[k], out=z)
            above, slope, bend = self._seen[k + 1][:-1], self._slopes[k], self._bends[k]
            self._activation(z[:, :n], above[:, :n], slope, bend)
            np.multiply(slope, z[:, n:], out=above[:, n:])
            bend *= z[:, n:]
        out = np.matmul(self._weights[-1], self._seen[-1], out=self._out)
        out *= self._scale
        return out[:, :n], out[:nx, n:]

    def reverse(self, by_out: np.ndarray, by_rate: np.ndarray) -> np.ndarray:
        """The gradient (n,) of what has these derivatives by what `forward` returned last."""
        n, nx = self._out.shape[-1] // 2, self._architecture.nx
        by_z = self._out
        by_z[:, :n], by_z[:nx, n:], by_z[nx:, n:] = by_out, by_rate, 0
        by_z *= self._scale
        size = sum(weights.size for weights in self._weights)
        gradient = np.empty(size, by_z.dtype)
        parts = _layers(self._architecture, gradient)
        for k in range(len(parts) - 1, 0, -1):
            _outer(by_z, self._seen[k], parts[k])
            by_a = self._work[k % 2]
            np.matmul(self._weights[k][:, :-1].T, by_z, out=by_a)
            slope, bend = self._slopes[k - 1], self._bends[k - 1]
            bend *= by_a[:, n:]
            by_a[:, :n] *= slope
            by_a[:, :n] += bend
            by_a[:, n:] *= slope
            by_z = by_a
        _outer(by_z, self._seen[0], parts[0])
        return gradient


def _outer(by_z: np.ndarray, seen: np.ndarray, out: np.ndarray) -> None:
    """by_z · seenᵀ, summed chunk by chunk."""
    np.matmul(by_z[:, :_CHUNK], seen[:, :_CHUNK].T, out=out)
    for start in range(_CHUNK, seen.shape[-1], _CHUNK):
        columns = slice(start, start + _CHUNK)
        out += by_z[:, columns] @ seen[:, columns].T
