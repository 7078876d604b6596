"""The fast recipe: a small network in scaled quantities, points that resolve the initial layer, and
a quasi-Newton method, in NumPy and float64."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pinnobs_gym.network import Architecture, Network
from pinnobs_gym.quasi_newton import QuasiNewton
from pinnobs_gym.record import Record
from pinnobs_gym.system import System
from trainers.pinn_obs.objective import Objective, Points, Weights
from trainers.pinn_obs.run import Run

UNITS = 20
"""Units of time in a record; one is the paper's second."""
NOISE = 0.01
"""Standard deviation of noise, over an output's scale, over which outputs weigh less."""
_DECAYS = (1e-3, 1e-2)
"""Time constants of the network's inputs, over the length of the record."""
_LAYER = (1e-5, 0.02, 60)
"""First and last of the points after t₀, over the length of the record, and their number."""
_GAIN = 10.0
"""What the network's gains are multiplied by, in units of state, output and time."""
_SLOPES = 10.0
"""Standard deviation of the first layer's weights on the time from −1 to 1."""
_PERIODS = 20
"""Periods in a record over which a frequency becomes an input of the network."""
_NOISY = 5
"""How many times as many samples are looked at if they are noisy."""


class FastRun(Run):
    """Self-scaled Broyden steps on the loss in scaled quantities.

    States are counted in `System.scale`, outputs in what that does to them, and time in twentieths
    of the record, so that the terms of the loss are of one size on any system. On the paper's
    ReverseDuffing that is within a factor of 1.7 of the paper's own loss, and the loss that is
    logged and returned is the paper's. A record without noise is looked at in `Config.points`
    samples, and in further points right after t₀, where x̂ has to leave x̂₀; otherwise the network
    jumps from x̂₀ to the trajectory where no residual is taken, and L is arbitrary. There y is
    joined by straight lines, as in the replay. Outputs of noise σ weigh less by (0.01/σ)², σ over
    their scale, if that is less than one, so that the equations decide and the fit does not chase
    it.
    """

    def _architecture(self) -> Architecture:
        config, system, t = self.config, self.system, self.record.t
        noisy = bool(self.noise_std.any())
        self.points = points_of(system, self.record, config.points * (_NOISY if noisy else 1))
        length = float(t[-1] - t[0])
        unit = length / UNITS
        x_scale, y_scale = np.asarray(system.scale, float), output_scale(system, self.record)
        per_gain = x_scale[:, None] / y_scale / unit
        quiet = np.minimum(1.0, (NOISE * y_scale / np.maximum(self.noise_std, 1e-100)) ** 2)
        self._weights = Weights(
            config.w0 / x_scale**2,
            config.w_ode * (unit / x_scale) ** 2,
            config.w_y * quiet / y_scale**2,
            config.gain_penalty / per_gain**2,
        )
        return Architecture(
            system.nx,
            system.ny,
            config.depth,
            config.width,
            config.activation,
            config.dtype,
            span=(float(t[0]), float(t[-1])),
            decays=tuple(length * part for part in _DECAYS),
            frequencies=fast_frequencies(self.record),
            scale=(*x_scale, *(_GAIN * per_gain).ravel()),
        )

    def _draw(self, generator: torch.Generator) -> None:
        network = Network(self.architecture, generator)
        with torch.no_grad():  # neurons with their middles all over the record
            weight, bias = network.weights[0], network.biases[0]
            slopes = _SLOPES * torch.randn(len(bias), generator=generator, dtype=bias.dtype)
            middles = 2 * torch.rand(len(bias), generator=generator, dtype=bias.dtype) - 1
            weight[:, 0], bias[:] = slopes, -slopes * middles
        parts = [p.detach().numpy().ravel() for p in _in_order(network)]
        self._first = np.concatenate(parts)
        self._objective = Objective(self.architecture, self.system, self.points, self._weights)
        self._method: QuasiNewton | None = None

    def step(self) -> None:
        self.iteration += 1
        if self._method is None:
            self._method = QuasiNewton.start(self._objective, self._first)
            if not math.isfinite(self._method.f):
                self.restart()
                return
        else:
            self.stuck = not self._method.step(self._objective)
        self._found(self._method.f, {"theta": torch.from_numpy(self._method.x)})

    def terms(self) -> np.ndarray:
        theta = self._first if self._method is None else self._method.x
        return self._objective.terms(theta)

    def held_out(self) -> None:
        return None

    def network(self) -> Network:
        assert self.best is not None
        network, theta = Network(self.architecture), self.best.weights["theta"]
        parts = theta.split([p.numel() for p in _in_order(network)])
        with torch.no_grad():
            for parameter, part in zip(_in_order(network), parts, strict=True):
                parameter.copy_(part.reshape(parameter.shape))
        return network

    def loss(self) -> float:
        assert self.best is not None
        return self.total(self._objective.terms(self.best.weights["theta"].numpy()))

    def _state(self) -> dict[str, Any]:
        assert self._method is not None
        H = self._method.H
        known = {} if H is None else {"H": torch.from_numpy(H.T)}
        return {**known, "gradient": torch.from_numpy(self._method.gradient)}

    def _take_up(self, state: Mapping[str, Any]) -> None:
        assert self.best is not None
        H = state["H"].numpy().T if "H" in state else None
        theta, gradient = self.best.weights["theta"].numpy(), state["gradient"].numpy()
        self._method = QuasiNewton(theta, self.best.loss, gradient, H)


def _in_order(network: Network) -> list[Tensor]:
    """The network's parameters as `Objective` strings them together."""
    pairs = zip(network.weights, network.biases, strict=True)
    return [parameter for pair in pairs for parameter in pair]


def points_of(system: System, record: Record, most: int) -> Points:
    """At most that many samples of a record of one episode, evenly chosen, and points between
    samples right after t₀."""
    t, y = record.t, record.y[0]
    length = t[-1] - t[0]
    chosen = np.unique(np.linspace(0, len(t) - 1, min(most, len(t))).round().astype(int))
    first, last, number = _LAYER
    layer = t[0] + length * np.geomspace(first, last, number)
    times = np.unique(np.concatenate([t[chosen], layer]))
    values = _on_lines(times, t, y)
    there = ~np.isnan(values)
    halves = np.diff(times) / length / 2
    weights = np.append(halves, 0.0) + np.append(0.0, halves)
    output = weights[:, None] * there
    u = _on_lines(times, t, record.u[0]) if system.measured_input else system.input(times)
    return Points(
        times,
        np.asarray(u),
        np.where(there, values, 0.0),
        there.astype(float),
        weights,
        output / np.maximum(output.sum(0), 1e-9),
        record.prior.mean[0],
    )


def _on_lines(times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (num_samples, n) at t, joined by straight lines, at times within; NaN along lines that
    begin or end in it."""
    after = np.clip(np.searchsorted(t, times, side="left"), 1, len(t) - 1)
    part = ((times - t[after - 1]) / (t[after] - t[after - 1]))[:, None]
    between = (1 - part) * values[after - 1] + part * values[after]
    return np.where(part == 0, values[after - 1], np.where(part == 1, values[after], between))


def output_scale(system: System, record: Record) -> np.ndarray:
    """The size of each output (ny,): what the states' scale does to it, or else its own spread."""
    scale, mean = np.asarray(system.scale, float), record.prior.mean[0]
    x = mean + scale * np.array([[-1.0], [0.0], [1.0]])
    by_model = abs(system.h_jacobian(x) * scale).max(axis=(0, 2))
    y = np.where(np.isnan(record.y[0]), 0.0, record.y[0])
    size = np.maximum(by_model, np.ptp(y, axis=0) * 1e-3)
    return np.where(size > 0, size, 1.0)


def fast_frequencies(record: Record) -> tuple[float, ...]:
    """The angular frequency (rad/s) of the highest peak in the outputs' spectrum, if more than
    twenty of its periods lie in the record; without it a small network cannot follow them."""
    t = record.t
    even = np.linspace(t[0], t[-1], len(t))
    power = np.zeros(len(t) // 2 + 1)
    for y in record.y[0].T:
        there = ~np.isnan(y)
        if there.any() and np.ptp(y[there]) > 0:
            wave = np.interp(even, t[there], (y[there] - y[there].mean()) / y[there].std())
            power += abs(np.fft.rfft(wave * np.hanning(len(t)))) ** 2
    peak = int(np.argmax(power))
    if not _PERIODS < peak < len(power) - 1:
        return ()
    below, here, above = np.log(power[peak - 1 : peak + 2] + 1e-300)
    place = peak + 0.5 * (below - above) / (below - 2 * here + above)
    cycle = (t[-1] - t[0]) * len(t) / (len(t) - 1)
    return (float(2 * np.pi * place / cycle),)
