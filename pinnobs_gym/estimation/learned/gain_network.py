"""What the learned gains compute, in the array API, for NumPy online and torch in training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, TypeAlias

from array_api_compat import array_namespace

from pinnobs_gym.estimation.learned.perceptron import perceptron
from pinnobs_gym.simulation.system import Array

Variant: TypeAlias = Literal["kalman", "gru"]

LARGEST_FACTOR = 8.0
"""What a Kalman gain can be multiplied or divided by."""
LARGEST_SHIFT = 1.0
"""Largest gain beside the Kalman one, in standard deviations of the state per one of the
innovation."""
LARGEST_GAIN = 2.0
"""Largest gain of the recurrent network, in scales of state and output."""
FADE = 0.75
"""Power of the share of P in S with which corrections fade."""
_NIS_RATE = 0.1
"""Weight of the latest sample in the moving average of squared normalised innovations."""
_LARGEST_NIS = 100.0
"""Where a squared normalised innovation is cut off in that average."""
_TINY = 1e-12


def shapes(variant: Variant, nx: int, ny: int, width: int) -> list[tuple[int, int]]:
    """Rows and columns of each weight matrix; each has a bias of as many rows beside it."""
    if variant == "kalman":
        inputs = 2 * nx + 3 * ny + nx * (nx - 1) // 2
        return [(width, inputs), (width, width), (2 * nx * ny, width)]
    return [(3 * width, nx + 2 * ny), (3 * width, width), (nx * ny, width)]


def memory_size(variant: Variant, ny: int, width: int) -> int:
    """How many numbers per row the network remembers from one sample to the next."""
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
    """Kalman gains as a small network corrects them, (nx, ny, batch).

    K·f(o₁s) + g(o₂s)·σ_P/√S, where f lies between 1/`LARGEST_FACTOR` and `LARGEST_FACTOR`, g
    between ±`LARGEST_SHIFT`, o₁ and o₂ are the network's outputs and s is the share of P in S to
    the power `FADE`. A network whose last layer is zero changes nothing, and every correction fades
    as P shrinks.

    All arrays have the batch last.

    Args:
        layers: weights and biases of a tanh network, see `shapes`.
        scale: the system's, shape (nx, 1).
        xhat: predictions, shape (nx, batch).
        P: their covariances, shape (nx, nx, batch).
        innovation: y − h(t, x̂, u), shape (ny, batch).
        S: variances of the innovations, shape (ny, batch).
        K: Kalman gains, shape (nx, ny, batch).
        share: diagonal of HPHᵀ over that of S, shape (ny, batch); zero where y is missing.
        memory: moving averages of squared normalised innovations, shape (ny, batch).
    """
    xp = array_namespace(xhat)
    nx = len(xhat)
    variance = _diagonal(P)
    sd = xp.sqrt(variance)
    root = xp.sqrt(share)
    features = [
        xhat / scale,
        xp.asinh(innovation / xp.sqrt(S)),
        xp.asinh(memory),
        xp.log(variance / scale**2 + _TINY) / 6,
        root,
    ]
    for i in range(1, nx):
        features.append(P[i, :i] / (sd[i] * sd[:i] + _TINY * scale[i] * scale[:i]))
    outputs = perceptron(layers, "tanh", xp.concat(features, axis=0).T).T
    factor, shift = xp.reshape(outputs, (2, *K.shape)) * share**FADE
    largest = math.log(LARGEST_FACTOR)
    return K * xp.exp(largest * xp.tanh(factor)) + LARGEST_SHIFT * xp.tanh(shift) * (
        sd[:, None] / xp.sqrt(S)
    )


def remembered(memory: Array, innovation: Array, S: Array, present: Array) -> Array:
    """The moving averages after a sample, (ny, batch): of e²/S where an output is present."""
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
    """Gains (nx, ny, batch) of a gated recurrent unit (Cho et al. 2014) and its next memory (width,
    batch). It has no covariance; a network whose last layer is zero corrects nothing.

    Args:
        layers: of the input, of the memory and of the output, see `shapes`.
        scale: the system's, shape (nx, 1).
        output_scale: the outputs' scale, shape (ny, 1).
        xhat: predictions, shape (nx, batch).
        innovation: y − h(t, x̂, u), zero where y is missing, shape (ny, batch).
        std: standard deviation of the output noise, shape (ny, batch).
        memory: shape (width, batch).
    """
    xp = array_namespace(xhat)
    (W, b), (V, c), (out, d) = layers
    size = len(memory)
    features = [xhat / scale, xp.asinh(innovation / std) / 3, xp.log(std / output_scale) / 4]
    given = W @ xp.concat(features, axis=0) + b[:, None]
    kept = V @ memory + c[:, None]
    gates = (1 + xp.tanh((given[: 2 * size] + kept[: 2 * size]) / 2)) / 2
    reset, update = gates[:size], gates[size:]
    new = xp.tanh(given[2 * size :] + reset * kept[2 * size :])
    memory = update * memory + (1 - update) * new
    o = xp.reshape(out @ memory + d[:, None], (len(scale), len(output_scale), -1))
    return LARGEST_GAIN * xp.tanh(o) * (scale[:, None] / output_scale), memory


def _diagonal(P: Array) -> Array:
    xp = array_namespace(P)
    return xp.stack([P[i, i] for i in range(len(P))])
