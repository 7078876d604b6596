"""The network of PINN-Obs, which maps a time to an estimate and an observer gain."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeAlias, get_args

import numpy as np
import torch

from pinnobs_gym.estimation.learned.perceptron import Layers, perceptron
from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.system import Array

Activation: TypeAlias = Literal["tanh", "sine", "sigmoid", "relu"]
"""Activation of hidden layers."""
Precision: TypeAlias = Literal["float32", "float64"]
"""Precision of a network."""

_DTYPES = {"float32": torch.float32, "float64": torch.float64}


@dataclass(frozen=True)
class Architecture:
    """The sizes of a multilayer perceptron t ↦ (x̂(t), L(t))."""

    nx: int
    """Number of states."""
    ny: int
    """Number of outputs."""
    depth: int = 9
    """Number of hidden layers."""
    width: int = 20
    """Neurons in each hidden layer."""
    activation: Activation = "tanh"
    """Activation of the hidden layers; the last layer is linear."""
    dtype: Precision = "float32"
    """Precision of the weights and of everything computed with them."""
    span: tuple[float, float] | None = None
    """First and last time in s, which are scaled to −1 and 1; if None, the input is the time in s
    since ``start``, as in the paper."""
    start: float = 0.0
    """Time in s from which the input counts without a ``span``: the first of the record, so that
    activations do not saturate on a record that begins late."""
    decays: tuple[float, ...] = ()
    """Time constants τ in s of additional inputs exp(−(t − t₀)/τ), with t₀ the first time of the
    span."""
    frequencies: tuple[float, ...] = ()
    """Angular frequencies ω in rad/s of additional inputs cos ω(t − t₀) and sin ω(t − t₀)."""
    scale: tuple[float, ...] | None = None
    """Factors of the network's outputs, shape (nx + nx·ny,): x̂ in state units, then L row by row;
    None for 1."""

    def __post_init__(self) -> None:
        if self.span is None and (self.decays or self.frequencies):
            raise ValueError("span=None; decays and frequencies need the times they begin at")
        if self.scale is not None and len(self.scale) != self.nx * (1 + self.ny):
            raise ValueError(f"scale={self.scale!r}; expected {self.nx * (1 + self.ny)} numbers")
        for name in ("nx", "ny", "depth", "width"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name}={value!r}; expected a whole number of at least 1")
        for name, choices in (("activation", Activation), ("dtype", Precision)):
            value, known = getattr(self, name), get_args(choices)
            if value not in known:
                raise ValueError(f"{name}={value!r}; expected one of {', '.join(known)}")

    @property
    def torch_dtype(self) -> torch.dtype:
        """The torch dtype of ``dtype``."""
        return _DTYPES[self.dtype]

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Numbers of neurons and of inputs of each layer, including the last."""
        inputs = 1 + len(self.decays) + 2 * len(self.frequencies)
        sizes = [inputs] + [self.width] * self.depth + [self.nx * (1 + self.ny)]
        return [(fan_out, fan_in) for fan_in, fan_out in pairwise(sizes)]

    def features(self, t: Array) -> tuple[Array, Array]:
        """Return the inputs of the first layer at times t (...) in s, and their time derivatives,
        (..., num_features) each, as arrays of t's library."""
        xp = array_namespace(t)
        if self.span is None:
            return (t - self.start)[..., None], xp.ones_like(t)[..., None]
        start, end = self.span
        since, rate = t - start, 2 / (end - start)
        values, rates = [rate * since - 1], [rate * xp.ones_like(t)]
        for tau in self.decays:
            values.append(xp.exp(-since / tau))
            rates.append(values[-1] / -tau)
        for omega in self.frequencies:
            cosine, sine = xp.cos(omega * since), xp.sin(omega * since)
            values += [cosine, sine]
            rates += [-omega * sine, omega * cosine]
        return xp.stack(values, axis=-1), xp.stack(rates, axis=-1)


def evaluate(
    architecture: Architecture, layers: Layers, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return x̂ (..., nx) in state units and L (..., nx, ny) at times t (...) in s, in float64
    (Farkane et al., PINN-Obs, "Proposed Adaptive PINN-Based Model").

    As in the paper, the network's input is the time in s since the record's first sample, unless
    the architecture has a ``span``.
    """
    features, _ = architecture.features(np.asarray(t, dtype=float))
    out = perceptron(layers, architecture.activation, features)
    if architecture.scale is not None:
        out *= architecture.scale
    nx, ny = architecture.nx, architecture.ny
    return out[..., :nx], out[..., nx:].reshape(*out.shape[:-1], nx, ny)
