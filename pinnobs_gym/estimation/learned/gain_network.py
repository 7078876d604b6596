"""The networks of learned gains, in the array API: NumPy online, torch in training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

from pinnobs_gym.estimation.kalman import kalman_gain, update_with
from pinnobs_gym.estimation.learned.perceptron import perceptron
from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.system import Array

Variant: TypeAlias = Literal["kalman", "gru"]
"""What the network gives: a correction of a Kalman gain, or the gain itself."""

LARGEST_FACTOR = 8.0
"""Largest factor by which a Kalman gain is multiplied or divided."""
LARGEST_SHIFT = 1.0
"""Largest gain added to the Kalman gain, in standard deviations of the state per standard deviation
of the innovation."""
LARGEST_GAIN = 2.0
"""Largest gain of the recurrent network, in scales of state and output."""
FADE = 0.75
"""Exponent of the share of HPHᵀ in S, by which corrections are damped."""
_NIS_RATE = 0.1
"""Weight of the latest sample in the moving average of squared normalised innovations."""
_LARGEST_NIS = 100.0
"""Upper bound of a squared normalised innovation in that average."""
_TINY = 1e-12


def shapes(variant: Variant, nx: int, ny: int, width: int) -> list[tuple[int, int]]:
    """Return the rows and columns of each weight matrix; its bias has as many entries as rows."""
    if variant == "kalman":
        inputs = 2 * nx + 3 * ny + nx * (nx - 1) // 2
        return [(width, inputs), (width, width), (2 * nx * ny, width)]
    return [(3 * width, nx + 2 * ny), (3 * width, width), (nx * ny, width)]


def memory_size(variant: Variant, ny: int, width: int) -> int:
    """Return the size of the network's memory per row of a batch."""
    return ny if variant == "kalman" else width


def corrected_gain(
    layers: Sequence[tuple[Array, Array]],
    scale: Array,
    xhat: Array,
    P: Array,
    innovation: Array,
    S: Array,
    K: Array,
    share: Array,
    memory: Array,
) -> Array:
    """Return Kalman gains corrected by a network, (nx, ny, batch).

    They are K·f(o₁s) + g(o₂s)·σ_P/√S, where f lies between 1/`LARGEST_FACTOR` and `LARGEST_FACTOR`,
    g between ±`LARGEST_SHIFT`, o₁ and o₂ are the network's outputs, and s is ``share`` to the power
    `FADE`. A network whose last layer is zero changes nothing, and every correction vanishes with
    P.

    The batch is the last axis of all arrays.

    Args:
        layers: weights and biases of a tanh network, see `shapes`.
        scale: the system's scale, shape (nx, 1).
        xhat: predictions, shape (nx, batch).
        P: covariances of the predictions, shape (nx, nx, batch).
        innovation: y − h(t, x̂, u), shape (ny, batch).
        S: variances of the innovations, shape (ny, batch).
        K: Kalman gains, shape (nx, ny, batch).
        share: diagonal of HPHᵀ over that of S, shape (ny, batch); zero for a missing output.
        memory: moving averages of squared normalised innovations, shape (ny, batch).
    """
    xp = array_namespace(xhat)
    nx = len(xhat)
    variance = _diagonal(P)
    sd = xp.sqrt(variance)
    root = xp.sqrt(share)
    # Features: estimate, normalised innovations and their average, variances, share of HPHᵀ in S.
    features = [
        xhat / scale,
        xp.asinh(innovation / xp.sqrt(S)),
        xp.asinh(memory),
        xp.log(variance / scale**2 + _TINY) / 6,
        root,
    ]
    for i in range(1, nx):  # correlations of the prediction errors
        features.append(P[i, :i] / (sd[i] * sd[:i] + _TINY * scale[i] * scale[:i]))
    outputs = perceptron(layers, "tanh", xp.concat(features, axis=0).T).T
    factor, shift = xp.reshape(outputs, (2, *K.shape)) * share**FADE
    # A bounded factor of the Kalman gain, and a bounded gain added to it.
    largest = math.log(LARGEST_FACTOR)
    return K * xp.exp(largest * xp.tanh(factor)) + LARGEST_SHIFT * xp.tanh(shift) * (
        sd[:, None] / xp.sqrt(S)
    )


def update_with_network(
    layers: Sequence[tuple[Array, Array]],
    scale: Array,
    xhat: Array,
    P: Array,
    innovation: Array,
    H: Array,
    R: Array,
    memory: Array,
    present: Array,
) -> tuple[Array, Array, Array, Array]:
    """Apply the Kalman update with the gains of `corrected_gain`.

    The batch is the last axis of all arrays.

    Args:
        layers: weights and biases of a tanh network, see `shapes`.
        scale: the system's scale, shape (nx, 1).
        xhat: predictions, shape (nx, batch).
        P: covariances of the predictions, shape (nx, nx, batch).
        innovation: y − h(t, x̂, u), shape (ny, batch); zero for a missing output.
        H: output Jacobians, shape (ny, nx, batch); zero for a missing output.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
        memory: moving averages of squared normalised innovations, shape (ny, batch).
        present: which outputs are present, bool, shape (ny, batch).

    Returns:
        Estimates (nx, batch), their covariances (nx, nx, batch), the covariances of the innovations
        (ny, ny, batch), and the next moving averages (ny, batch).
    """
    xp = array_namespace(innovation)
    K, S = kalman_gain(P, H, R)
    variance = _diagonal(S)
    share = 1 - _diagonal(R) / variance
    share = xp.where(share < 0, xp.zeros_like(share), share)  # below zero by rounding alone
    K = corrected_gain(layers, scale, xhat, P, innovation, variance, K, share, memory)
    memory = remembered(memory, innovation, variance, present)
    after, P = update_with(K, xhat.T, P, innovation.T, H, R)
    return after.T, P, S, memory


def remembered(memory: Array, innovation: Array, S: Array, present: Array) -> Array:
    """Update the moving averages of e²/S, (ny, batch), at outputs that are present."""
    xp = array_namespace(innovation)
    nis = innovation * innovation / S
    nis = xp.where(nis > _LARGEST_NIS, _LARGEST_NIS, nis)
    return xp.where(present, memory + _NIS_RATE * (nis - memory), memory)


def recurrent_gain(
    layers: Sequence[tuple[Array, Array]],
    scale: Array,
    output_scale: Array,
    xhat: Array,
    innovation: Array,
    std: Array,
    memory: Array,
) -> tuple[Array, Array]:
    """Return the gains of a gated recurrent unit (Cho et al. 2014) and its next hidden state.

    The unit uses no covariance. A network whose last layer is zero has zero gains.

    Args:
        layers: weights and biases of the input, the hidden state and the output, see `shapes`.
        scale: the system's scale, shape (nx, 1).
        output_scale: scale of the outputs, shape (ny, 1).
        xhat: predictions, shape (nx, batch).
        innovation: y − h(t, x̂, u), zero for a missing output, shape (ny, batch).
        std: standard deviation of the output noise, shape (ny, batch).
        memory: hidden state, shape (width, batch).

    Returns:
        The gains (nx, ny, batch), and the next hidden state (width, batch).
    """
    xp = array_namespace(xhat)
    (W, b), (V, c), (out, d) = layers
    size = len(memory)
    features = [xhat / scale, xp.asinh(innovation / std) / 3, xp.log(std / output_scale) / 4]
    # Reset and update gates, with the logistic function written as a tanh.
    from_input = W @ xp.concat(features, axis=0) + b[:, None]
    from_memory = V @ memory + c[:, None]
    gates = (1 + xp.tanh((from_input[: 2 * size] + from_memory[: 2 * size]) / 2)) / 2
    reset, update = gates[:size], gates[size:]
    # Candidate state, and the interpolation between it and the old one.
    new = xp.tanh(from_input[2 * size :] + reset * from_memory[2 * size :])
    memory = update * memory + (1 - update) * new
    # Output layer; the tanh bounds the gains.
    o = xp.reshape(out @ memory + d[:, None], (len(scale), len(output_scale), -1))
    return LARGEST_GAIN * xp.tanh(o) * (scale[:, None] / output_scale), memory


def _diagonal(P: Array) -> Array:
    xp = array_namespace(P)
    return xp.stack([P[i, i] for i in range(len(P))])
